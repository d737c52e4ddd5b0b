// The interactive view: the part with flat shading, the scan as dots, orbit, zoom and move.
// It needs WebGL 2 and nothing else; where that is missing, the page keeps its static picture.
(() => {
  "use strict";
  const figure = document.getElementById("viewer");
  const canvas = figure.querySelector("canvas");
  const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) {
    document.body.dataset.viewer = "unavailable";
    return;
  }
  const scene = JSON.parse(document.getElementById("scene").textContent);

  function numbers(text, Type) {
    const bytes = atob(text);
    const array = new Uint8Array(bytes.length);
    for (let i = 0; i < bytes.length; i++) array[i] = bytes.charCodeAt(i);
    return new Type(array.buffer);
  }
  const points = numbers(scene.scan.points, Uint16Array);
  const deviation = numbers(scene.scan.deviation_um, Int16Array);
  const faces = numbers(scene.mesh.faces, Uint16Array);

  // ---- programs -------------------------------------------------------------------------------
  const PART = [`#version 300 es
    uniform mat4 model, view, projection;
    layout(location = 0) in vec3 position;
    out vec3 eye;
    void main() {
      vec4 p = view * model * vec4(position, 1.0);
      eye = p.xyz;
      gl_Position = projection * p;
    }`, `#version 300 es
    precision highp float;
    in vec3 eye;
    out vec4 color;
    void main() {
      vec3 normal = normalize(cross(dFdx(eye), dFdy(eye)));
      if (dot(normal, eye) > 0.0) normal = -normal;
      float key = max(dot(normal, normalize(vec3(-0.45, 0.55, 0.70))), 0.0);
      float fill = max(dot(normal, normalize(vec3(0.80, -0.10, 0.60))), 0.0);
      color = vec4(vec3(0.60, 0.65, 0.71) * (0.42 + 0.52 * key + 0.2 * fill), 1.0);
    }`];
  const DOTS = [`#version 300 es
    uniform mat4 model, view, projection;
    uniform float lift, diameter, smallest, limit;
    uniform bool measured;
    uniform vec3 scanColor, lostColor;
    uniform sampler2D colors;
    layout(location = 0) in vec3 position;
    layout(location = 1) in float deviation;
    out vec3 tint;
    void main() {
      vec4 p = view * model * vec4(position, 1.0);
      gl_PointSize = clamp(diameter / -p.z, smallest, 24.0);
      // Deviations are drawn on the surface, not below it, and chance decides which of two dots is
      // in front: depth alone would show those that deviate to the outside and hide the others.
      float chance = fract(sin(float(gl_VertexID % 9973) * 12.9898) * 4375.5453);
      float nearness = measured ? lift * (1.0 + 2.0 * chance) : 0.0;
      vec4 nearer = projection * (p - vec4(normalize(p.xyz) * nearness, 0.0));
      gl_Position = projection * p;
      gl_Position.z = nearer.z / nearer.w * gl_Position.w;
      float place = clamp(0.5 + 0.5 * deviation / limit, 0.002, 0.998);
      tint = !measured ? scanColor
        : deviation < -32767.5 ? lostColor
        : texture(colors, vec2(place, 0.5)).rgb;
    }`, `#version 300 es
    precision highp float;
    in vec3 tint;
    out vec4 color;
    void main() {
      vec2 p = 2.0 * gl_PointCoord - 1.0;
      if (dot(p, p) > 1.0) discard;
      color = vec4(tint, 1.0);
    }`];

  function program([vertex, fragment]) {
    const made = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    const uniforms = {};
    const count = gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS) || 0;
    for (let i = 0; i < count; i++) {
      const { name } = gl.getActiveUniform(made, i);
      uniforms[name] = gl.getUniformLocation(made, name);
    }
    return { made, uniforms };
  }

  function buffer(target, values) {
    gl.bindBuffer(target, gl.createBuffer());
    gl.bufferData(target, values, gl.STATIC_DRAW);
  }

  let part, dots, partArray, dotArray;
  function upload() {
    part = program(PART);
    dots = program(DOTS);
    partArray = gl.createVertexArray();
    gl.bindVertexArray(partArray);
    buffer(gl.ARRAY_BUFFER, numbers(scene.mesh.vertices, Uint16Array));
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.UNSIGNED_SHORT, true, 0, 0);
    buffer(gl.ELEMENT_ARRAY_BUFFER, faces);
    dotArray = gl.createVertexArray();
    gl.bindVertexArray(dotArray);
    buffer(gl.ARRAY_BUFFER, points);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.UNSIGNED_SHORT, true, 0, 0);
    buffer(gl.ARRAY_BUFFER, deviation);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribPointer(1, 1, gl.SHORT, false, 0, 0);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE,
      numbers(scene.colors, Uint8Array));
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    gl.enable(gl.DEPTH_TEST);
  }

  // ---- where the reader stands; matrices are column-major ------------------------------------------
  const TANGENT = Math.tan(Math.PI / 12);
  const FAR = scene.radius / Math.sin(Math.PI / 12);
  const state = { pose: 1, showPart: true, showScan: true };
  const aspect = () => canvas.clientWidth / Math.max(1, canvas.clientHeight);
  // the slope of the upper edge of what is seen; a narrow view sees as much to the sides
  const slope = () => TANGENT / Math.min(1, aspect() || 1);
  // the distance at which the part fills the view; a view may get its size after it is loaded
  function fitted() {
    const [x, y, z] = scene.half_mm;
    return 1.08 * Math.max(y, x / (aspect() || 1)) / slope() + 0.5 * z;
  }
  function reset() {
    const distance = (state.fitted = fitted());
    Object.assign(state, { distance, x: 0, y: 0, rotation: scene.view.slice() });
  }
  function resize() {
    state.distance *= fitted() / state.fitted;
    state.fitted = fitted();
    redraw();
  }

  function product(a, b) {
    const c = new Array(16).fill(0);
    for (let col = 0; col < 4; col++)
      for (let row = 0; row < 4; row++)
        for (let k = 0; k < 4; k++) c[4 * col + row] += a[4 * k + row] * b[4 * col + k];
    return c;
  }
  function turn(aboutX, aboutY) {
    const [cx, sx, cy, sy] = [Math.cos(aboutX), Math.sin(aboutX), Math.cos(aboutY), Math.sin(aboutY)];
    const x = [1, 0, 0, 0, 0, cx, sx, 0, 0, -sx, cx, 0, 0, 0, 0, 1];
    const y = [cy, 0, -sy, 0, 0, 1, 0, 0, sy, 0, cy, 0, 0, 0, 0, 1];
    state.rotation = product(product(x, y), state.rotation);
  }
  function view() {
    const matrix = state.rotation.slice();
    [matrix[12], matrix[13], matrix[14]] = [state.x, state.y, -state.distance];
    return matrix;
  }
  function projection() {
    const near = Math.max(state.distance - 4 * scene.radius, 0.02 * state.distance);
    const far = state.distance + 4 * scene.radius;
    return [1 / (slope() * aspect()), 0, 0, 0, 0, 1 / slope(), 0, 0, 0, 0, (near + far) / (near - far),
      -1, 0, 0, (2 * near * far) / (near - far), 0];
  }

  // ---- drawing, when something has changed ----------------------------------------------------------
  let waiting = false;
  let frames = 0;
  function redraw() {
    if (!waiting) requestAnimationFrame(draw);
    waiting = true;
  }
  function draw() {
    waiting = false;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((s) => Math.round(s * ratio));
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const pose = scene.poses[state.pose];
    const matrices = [["view", view()], ["projection", projection()]];
    if (state.showPart) {
      gl.useProgram(part.made);
      for (const [name, matrix] of [...matrices, ["model", scene.mesh.model]])
        gl.uniformMatrix4fv(part.uniforms[name], false, matrix);
      gl.bindVertexArray(partArray);
      gl.drawElements(gl.TRIANGLES, faces.length, gl.UNSIGNED_SHORT, 0);
    }
    if (state.showScan) {
      gl.useProgram(dots.made);
      for (const [name, matrix] of [...matrices, ["model", pose.model]])
        gl.uniformMatrix4fv(dots.uniforms[name], false, matrix);
      gl.uniform1f(dots.uniforms.lift, scene.scan.lift_mm);
      gl.uniform1f(dots.uniforms.diameter, (2.1 * scene.scan.spacing_mm * height) / (2 * slope()));
      gl.uniform1f(dots.uniforms.smallest, 1.6 * ratio);
      gl.uniform1f(dots.uniforms.limit, 1000 * scene.limit_mm);
      gl.uniform1i(dots.uniforms.measured, pose.measured ? 1 : 0);
      gl.uniform3fv(dots.uniforms.scanColor, scene.scan_color);
      gl.uniform3fv(dots.uniforms.lostColor, scene.lost_color);
      gl.uniform1i(dots.uniforms.colors, 0);
      gl.bindVertexArray(dotArray);
      gl.drawArrays(gl.POINTS, 0, deviation.length);
    }
    document.body.dataset.rendered = String(++frames);
    document.body.dataset.pose = pose.name;
  }

  // ---- what one point says ------------------------------------------------------------------------------
  const readout = figure.querySelector(".readout");
  function say(x, y) {
    const pose = scene.poses[state.pose];
    readout.textContent = "";
    if (!state.showScan || !pose.measured) return;
    const m = product(product(projection(), view()), pose.model).map((v, i) => (i < 12 ? v / 65535 : v));
    const [w, h] = [canvas.clientWidth / 2, canvas.clientHeight / 2];
    let [best, nearest] = [-1, Infinity];
    for (let i = 0; i < deviation.length; i++) {
      const [a, b, c] = [points[3 * i], points[3 * i + 1], points[3 * i + 2]];
      const depth = m[3] * a + m[7] * b + m[11] * c + m[15];
      const dx = w + (w * (m[0] * a + m[4] * b + m[8] * c + m[12])) / depth - x;
      const dy = h - (h * (m[1] * a + m[5] * b + m[9] * c + m[13])) / depth - y;
      if (depth > 0 && depth < nearest && dx * dx + dy * dy < 16) [best, nearest] = [i, depth];
    }
    if (best < 0) return;
    const value = deviation[best] / 1000;
    readout.textContent = deviation[best] === -32768 ? "no partner on the part"
      : `${value > 0 ? "+" : value < 0 ? "−" : ""}${Math.abs(value).toFixed(3)} mm`;
  }

  // ---- hands -----------------------------------------------------------------------------------------
  const held = new Map();
  const zoom = (factor) => {
    state.distance = Math.min(Math.max(state.distance * factor, 0.15 * FAR), 6 * FAR);
  };
  const perPixel = () => (2 * slope() * state.distance) / canvas.clientHeight;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, event);
  });
  for (const name of ["pointerup", "pointercancel"])
    canvas.addEventListener(name, (event) => held.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const last = held.get(event.pointerId);
    if (!last) {
      say(event.offsetX, event.offsetY);
      return;
    }
    const [dx, dy] = [event.clientX - last.clientX, event.clientY - last.clientY];
    if (held.size === 2) {
      const other = [...held.values()].find((e) => e.pointerId !== event.pointerId);
      const gap = (e) => Math.hypot(e.clientX - other.clientX, e.clientY - other.clientY);
      zoom(Math.max(gap(last), 1) / Math.max(gap(event), 1));
      state.x += 0.5 * dx * perPixel();
      state.y -= 0.5 * dy * perPixel();
    } else if (event.buttons & 2 || event.shiftKey) {
      state.x += dx * perPixel();
      state.y -= dy * perPixel();
    } else turn(0.008 * dy, 0.008 * dx);
    held.set(event.pointerId, event);
    redraw();
  });
  canvas.addEventListener("pointerleave", () => { readout.textContent = ""; });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 30 : 1;
    zoom(Math.exp(0.0012 * lines * event.deltaY));
    redraw();
  }, { passive: false });
  const KEYS = {
    ArrowLeft: () => turn(0, -0.12), ArrowRight: () => turn(0, 0.12),
    ArrowUp: () => turn(-0.12, 0), ArrowDown: () => turn(0.12, 0),
    "+": () => zoom(0.88), "=": () => zoom(0.88), "-": () => zoom(1.14), Home: reset,
  };
  canvas.addEventListener("keydown", (event) => {
    if (!KEYS[event.key]) return;
    event.preventDefault();
    KEYS[event.key]();
    redraw();
  });

  // ---- buttons -----------------------------------------------------------------------------------------
  const poseButtons = [...document.querySelectorAll("button[data-pose]")];
  const show = (index) => {
    state.pose = index;
    for (const b of poseButtons) b.setAttribute("aria-pressed", String(Number(b.dataset.pose) === index));
    figure.dataset.measured = String(scene.poses[index].measured);
    readout.textContent = "";
    redraw();
  };
  for (const b of poseButtons) b.addEventListener("click", () => show(Number(b.dataset.pose)));
  for (const box of figure.querySelectorAll("input[data-show]"))
    box.addEventListener("change", () => { state[box.dataset.show] = box.checked; redraw(); });
  figure.querySelector("button[data-reset]").addEventListener("click", () => { reset(); redraw(); });
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => { upload(); redraw(); });
  new ResizeObserver(resize).observe(canvas);

  upload();
  document.body.dataset.viewer = "ready"; // the canvas has a size from here on
  reset();
  show(state.pose);
})();
