"""The scanner against analytic shapes and against a slow float64 ray caster."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.spatial
import trimesh
from example_scans import solid

from vanejax.cad import Part, part_from_mesh
from vanejax.errors import InputError
from vanejax.rigid import RigidTransform
from vanejax.scanner import Camera, Scan, Scanner, hemisphere_viewpoints, look_at, scan_views

ORIGIN = np.zeros(3)
ABOVE = look_at(np.array([0.0, 0.0, 400.0]), ORIGIN)
OBLIQUE = look_at(400 * np.array([0.43301, 0.25, 0.86603]), ORIGIN)  # elevation 60, azimuth 30
# half a unit in the last place of a float32 between 256 and 512 is 1.5e-5 mm; three coordinates
ROUNDING_MM = 5e-5
ARRAYS = ("points", "normals", "range_mm", "face", "incidence_deg", "pixel", "hidden")


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[low, high])


def bumpy(seed: int = 3) -> trimesh.Trimesh:
    """A closed, not convex solid of 320 faces that shadows itself; generic, so no exact ties."""
    mesh = trimesh.creation.torus(35, 14, major_sections=16, minor_sections=10)
    rng = np.random.default_rng(seed)
    mesh.vertices += rng.normal(0, 1.5, mesh.vertices.shape)
    mesh.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
    return mesh


@pytest.fixture(scope="module")
def ring() -> Part:
    return solid(bumpy())


def ray_directions(camera: Camera, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    x, y = camera.slopes(column, row)
    rays = np.stack([x, y, np.full_like(x, -1.0)], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def moller_trumbore(part: Part, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """All crossings: parameters [N, F] f64 in lengths of `directions`; inf where there is none."""
    a, b, c = np.moveaxis(np.asarray(part.mesh.triangles, np.float64), 1, 0)
    e1, e2 = b - a, c - a
    p = np.cross(directions[:, None], e2)
    det = np.sum(p * e1, axis=-1)
    s = origins[:, None] - a
    q = np.cross(s, e1)
    u = np.sum(s * p, axis=-1) / det
    v = np.sum(directions[:, None] * q, axis=-1) / det
    t = np.sum(e2 * q, axis=-1) / det
    return np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)


def scan_as_by_a_ray_caster(part: Part, camera: Camera, pose: RigidTransform) -> Scan:
    """The part's scan, of which every pixel is held against a float64 ray caster."""
    row, column = np.divmod(np.arange(camera.width * camera.height), camera.width)
    rays = pose.inverse().rotate(ray_directions(camera, column, row))
    eye = np.broadcast_to(pose.inverse().translation, rays.shape)
    crossings = moller_trumbore(part, eye, rays)
    expected = crossings.min(axis=1)
    scan = Scanner(part).scan(camera, pose)
    np.testing.assert_array_equal(scan.pixel, np.flatnonzero(np.isfinite(expected)))
    np.testing.assert_array_equal(scan.face, crossings[scan.pixel].argmin(axis=1))
    np.testing.assert_allclose(scan.range_mm, expected[scan.pixel], atol=ROUNDING_MM, rtol=0)
    normals = np.asarray(part.mesh.face_normals)[scan.face]
    np.testing.assert_allclose(scan.normals, pose.rotate(normals), atol=2e-7)  # f32 eps x 2
    incidence = np.degrees(np.arccos(-np.sum(normals * rays[scan.pixel], axis=-1)))
    np.testing.assert_allclose(scan.incidence_deg, incidence, atol=2e-5)  # f32 eps x 90 deg x 2
    for values in (scan.points, scan.normals, scan.face, scan.pixel):
        assert values.flags.owndata  # no memory is kept that no pixel took
    return scan


@pytest.mark.parametrize(
    "camera",
    [
        Camera(width=80, height=64),
        Camera(width=120, height=90, fov_x_deg=110.0, fov_y_deg=90.0),
        Camera(width=80, height=64, fov_x_deg=6.0, fov_y_deg=3.0),
    ],
)
@pytest.mark.parametrize("pose", [ABOVE, OBLIQUE])
def test_every_pixel_agrees_with_a_float64_ray_caster(ring, camera, pose):
    assert len(scan_as_by_a_ray_caster(ring, camera, pose).pixel) > 25


def test_more_faces_than_rays_and_chunks_of_both(monkeypatch):
    """Planes are then turned for each hit; and each chunk's are those of its own faces."""
    monkeypatch.setattr("vanejax.scanner.virtual_scanner.RAYS_PER_STRIP", 100)
    fine = trimesh.creation.torus(35, 14, major_sections=32, minor_sections=20)
    fine.vertices += np.random.default_rng(3).normal(0, 0.5, fine.vertices.shape)
    part = solid(fine)
    monkeypatch.setattr("vanejax.scanner.virtual_scanner.FACES_AT_ONCE", 7)
    monkeypatch.setattr("vanejax.scanner.pixel_rays.ROWS_AT_ONCE", 7)
    scan = scan_as_by_a_ray_caster(part, Camera(width=40, height=32), OBLIQUE)
    assert 80 < len(scan.pixel) < len(part.mesh.faces) / 5


def split_samples(part: Part, scan: Scan) -> tuple[np.ndarray, np.ndarray]:
    """The default surface samples [20000, 3] and whether the scan calls each one hidden."""
    samples, _, _ = part.sample(20_000, 0)
    moved = scan.camera_from_part.apply(samples).astype(np.float64)
    # hidden points are samples, moved with another order of rounding and stored as float32
    distance, index = scipy.spatial.cKDTree(moved).query(scan.hidden.astype(np.float64))
    assert distance.max() < 2 * ROUNDING_MM
    assert len(np.unique(index)) == len(index)
    hidden = np.zeros(len(samples), bool)
    hidden[index] = True
    return samples, hidden


def test_hidden_samples_agree_with_a_float64_ray_caster(ring):
    scan = Scanner(ring).scan(Camera(width=80, height=64), OBLIQUE, hidden=True)
    samples, hidden = split_samples(ring, scan)
    samples, hidden = samples[:3000], hidden[:3000]
    _, _, face = ring.sample(20_000, 0)
    eye = OBLIQUE.inverse().translation
    crossings = moller_trumbore(ring, samples, eye - samples)
    crossings[np.arange(3000), face[:3000]] = np.inf  # its own triangle
    crossings[crossings > 1] = np.inf  # behind the camera
    towards = np.sum(np.asarray(ring.mesh.face_normals)[face[:3000]] * (eye - samples), axis=-1)
    expected = np.isfinite(crossings).any(axis=1) | (towards < 0)
    # a sample within 1e-5 of a shadow's border may differ: at most one in a thousand
    assert np.mean(hidden != expected) <= 1e-3
    assert 0.3 < expected.mean() < 0.9


def test_clip_planes_cut_as_a_renderer_s_do():
    """Two plates under a camera at z = 400: depths 290 to 310 and 395 to 405 mm."""
    part = solid(box((-30, -30, 90), (30, 30, 110)), box((-30, -30, -5), (30, 30, 5)))
    scanner = Scanner(part)

    def depths(near_mm: float, far_mm: float) -> np.ndarray:
        camera = Camera(near_mm=near_mm, far_mm=far_mm).scaled(0.1)
        scan = scanner.scan(camera, ABOVE, hidden=True)
        assert (np.sum(scan.normals * scan.points, axis=-1) < 0).all()
        seen, unseen = (-p[(np.abs(p[:, :2]) < 15).all(1), 2] for p in (scan.points, scan.hidden))
        for face in (290, 310, 395, 405):  # in its middle a face is scanned or hidden, never both
            assert (np.abs(seen - face) < 1e-3).any() != (np.abs(unseen - face) < 1e-3).any()
        return np.unique(np.round(seen, 3))

    assert depths(100, 1300).tolist() == [290]
    assert depths(290 + 1e-3, 1300).tolist() == [310]  # seen from inside the cut plate
    assert depths(320, 1300).tolist() == [395]
    assert depths(400, 1300).tolist() == [405]
    assert depths(100, 300).tolist() == [290]
    with pytest.raises(InputError, match="beyond its far plane at 280"):
        scanner.scan(Camera(near_mm=100, far_mm=280), ABOVE)
    with pytest.raises(InputError, match="before its near plane at 500"):
        scanner.scan(Camera(near_mm=500), ABOVE)
    with pytest.raises(InputError, match="between the clip planes"):
        scanner.scan(Camera(near_mm=320, far_mm=390), ABOVE)


@pytest.mark.parametrize("beside_mm", [0.0, -0.2])
def test_a_face_seen_edge_on_is_not_measured(beside_mm):
    """The face x = 0 is seen at 90 or 89.97 deg; the rays of the middle column run along it."""
    part, camera = solid(box((0, -30, -30), (40, 30, 30))), Camera(width=1281)
    pose = look_at(np.array([beside_mm, 0.0, 400.0]), ORIGIN)
    scan = Scanner(part).scan(camera, pose, hidden=True)
    for values in (scan.points, scan.normals, scan.range_mm, scan.incidence_deg):
        assert np.isfinite(values).all()
    assert scan.incidence_deg.max() < 89.95
    at_part = pose.inverse().apply(scan.points.astype(np.float64))
    np.testing.assert_allclose(at_part[:, 2], 30, atol=ROUNDING_MM)  # nothing but the top
    samples, hidden = split_samples(part, scan)
    assert hidden[(np.abs(samples[:, 0]) < 1e-6) & (np.abs(samples[:, 2]) < 29)].all()


def test_the_same_scan_wherever_the_part_frame_is(ring):
    """Part and camera moved together: the same pixels and ranges."""
    shift = np.array([64.0, -512.0, 128.0])
    moved = part_from_mesh(ring.mesh.vertices + shift, ring.mesh.faces, name="moved")
    camera = Camera().scaled(0.1)
    eye = OBLIQUE.inverse().translation
    here, there = (
        Scanner(part).scan(camera, look_at(eye + delta, delta))
        for part, delta in ((ring, ORIGIN), (moved, shift))
    )
    # a part stored in float32 around 512 mm is rounded by up to 3e-5 mm: few pixels may differ
    both = np.isin(here.pixel, there.pixel)
    assert both.mean() > 0.99
    error = here.range_mm[both] - there.range_mm[np.isin(there.pixel, here.pixel)]
    frontal = here.incidence_deg[both] < 60
    assert np.abs(error[frontal]).max() < 1e-3


def test_cast_agrees_with_a_float64_ray_caster(ring):
    rng = np.random.default_rng(0)
    origins = rng.normal(size=(2000, 3)) * 300
    targets = rng.normal(size=(2000, 3)) * 30
    origins[:200] = rng.normal(size=(200, 3)) * 20  # within the part's bounding sphere
    directions = (targets - origins) * rng.uniform(0.1, 3, (2000, 1))
    kept = origins.copy(), directions.copy()
    hits = Scanner(ring).cast(origins, directions)
    np.testing.assert_array_equal(origins, kept[0])
    np.testing.assert_array_equal(directions, kept[1])
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    crossings = moller_trumbore(ring, origins, unit)
    expected, found = crossings.min(axis=1), hits.face >= 0
    normals = np.asarray(ring.mesh.face_normals)[crossings.argmin(axis=1)]
    from_inside = np.isfinite(expected) & (np.sum(normals * unit, axis=-1) > 0)
    assert from_inside.sum() > 20
    expected[from_inside] = np.inf
    np.testing.assert_array_equal(found, np.isfinite(expected))
    assert 300 < found.sum() < 1900
    np.testing.assert_array_equal(hits.face[found], crossings[found].argmin(axis=1))
    np.testing.assert_allclose(hits.distance_mm, expected, atol=1e-9)  # f64 eps x 1e3 mm x 1e4
    np.testing.assert_array_equal(hits.normals[~found], 0)
    assert (np.sum(hits.normals * unit, axis=-1)[found] < 0).all()


def test_rays_through_edges_and_vertices_do_not_slip_in():
    part = solid(trimesh.creation.icosphere(5, 50.0))
    eye = np.array([100.0, 150.0, 350.0])
    vertices = np.asarray(part.mesh.vertices)
    ends = vertices[part.mesh.edges_unique]
    share = np.linspace(0.1, 0.9, 5)[:, None, None]
    for on_mesh, least in (
        ((share * ends[:, 0] + (1 - share) * ends[:, 1]).reshape(-1, 3), 1.0),
        (vertices, 0.9),  # one in a hundred slips in and is dropped
    ):
        on_mesh = on_mesh[on_mesh @ eye > 1.2 * 50**2]  # well before the horizon
        rays = on_mesh - eye
        hits = Scanner(part).cast(np.broadcast_to(eye, rays.shape), rays)
        found = hits.face >= 0
        assert len(found) > 4000
        assert found.mean() >= least
        # 1e-5 mm beside the edge, x 10 for neighbours that lie oblique to the ray
        expected = np.linalg.norm(rays, axis=-1)
        np.testing.assert_allclose(hits.distance_mm[found], expected[found], atol=1e-4, rtol=0)


@pytest.mark.parametrize("near_mm", [50.0, 99.9])  # the latter cuts the envelope, not the part
def test_pixels_that_look_at_vertices_do_not_see_the_inside(near_mm):
    """A relief with a vertex on every pixel's ray, and a post so near that rays start far away."""
    camera = Camera(width=61, height=51, near_mm=near_mm)
    row, column = np.divmod(np.arange(camera.width * camera.height), camera.width)
    depth = 400 + np.random.default_rng(0).uniform(-1, 1, row.size)
    x, y = camera.slopes(column, row)
    top = depth[:, None] * np.stack([x, y, np.full_like(x, -1)], axis=-1)
    rim = (row % 50 == 0) | (column % 60 == 0)
    bottom = np.where(rim[:, None], top, top - [0, 0, 30])  # a lens: the two sheets share the rim
    corner = np.arange(row.size).reshape(51, 61)
    a, b = corner[1:, :-1].ravel(), corner[1:, 1:].ravel()
    c, d = corner[:-1, 1:].ravel(), corner[:-1, :-1].ravel()
    sheet = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    faces = np.concatenate([sheet, sheet[:, ::-1] + row.size])
    lens = trimesh.Trimesh(np.concatenate([top, bottom]), faces)
    post = box((30, 0, -110), (31, 1, -100))
    scan = Scanner(solid(lens, post)).scan(camera, RigidTransform(np.eye(3), np.zeros(3)))
    expected = depth * np.hypot(np.hypot(x, y), 1)
    relief = (scan.range_mm > 200) & ~rim[scan.pixel]  # at the rim a ray may pass by
    assert relief.sum() > 0.98 * (~rim).sum()
    # slopes up to 2 in 4 mm; a vertex is off its ray by float32's 3e-5 mm
    np.testing.assert_allclose(
        scan.range_mm[relief], expected[scan.pixel[relief]], atol=1e-3, rtol=0
    )


@pytest.mark.parametrize(
    ("origins", "directions", "message"),
    [
        (np.zeros((2, 3)), np.ones((3, 3)), "origins and directions"),
        (np.zeros(3), np.ones(3), "origins and directions"),
        (np.zeros((1, 3)), np.zeros((1, 3)), "zero"),
        (np.full((1, 3), np.nan), np.ones((1, 3)), "finite"),
    ],
)
def test_cast_refuses_what_are_no_rays(ring, origins, directions, message):
    with pytest.raises(InputError, match=message):
        Scanner(ring).cast(origins, directions)


def test_a_camera_that_sees_nothing_says_why(ring):
    scanner, camera = Scanner(ring), Camera()
    away = RigidTransform(np.eye(3), np.array([0.0, 0.0, 400.0]))
    for pose, message in (
        (away, "behind the camera"),
        (look_at(np.array([0.0, 0.0, 100.0]), ORIGIN), "near plane at 300 mm"),
        (look_at(np.array([0.0, 0.0, 2000.0]), ORIGIN), "far plane at 1300 mm"),
        (look_at(np.array([0.0, 0.0, 400.0]), np.array([300.0, 0.0, 0.0])), "field of view"),
    ):
        with pytest.raises(InputError, match=message):
            scanner.scan(camera, pose)
    with pytest.raises(InputError, match="too small"):  # four pixels look past the ring, or through
        scanner.scan(Camera(width=2, height=2), ABOVE)
    with pytest.raises(InputError, match="one pose"):
        scanner.scan(camera, hemisphere_viewpoints(ORIGIN).camera_from_part)


def test_a_camera_inside_the_part_is_refused():
    scanner = Scanner(solid(trimesh.creation.icosphere(2, 1000.0)))
    with pytest.raises(InputError, match="inside the part solid"):
        scanner.scan(Camera(), ABOVE)
    with pytest.MonkeyPatch.context() as patch:  # the largest face need not be in the first chunk
        patch.setattr("vanejax.scanner.virtual_scanner.FACES_AT_ONCE", 7)
        with pytest.raises(InputError, match="inside the part solid"):
            scanner.scan(Camera(), ABOVE)
    # in the hole of a ring it is not inside, though within the part's bounding sphere
    ring = Scanner(solid(trimesh.creation.torus(400, 50)))
    scan = ring.scan(Camera(near_mm=100), look_at(ORIGIN, np.array([1.0, 0.0, 0.1])))
    np.testing.assert_allclose(scan.range_mm.min(), 350, atol=2.0)  # facets of the ring


def test_two_workers_give_the_bits_of_one(ring):
    camera = Camera().scaled(0.25)
    views = hemisphere_viewpoints(ORIGIN).select(slice(0, 216, 20))
    one, two, again = (
        scan_views(ring, camera, views, hidden=True, workers=workers, progress=False)
        for workers in (1, 2, 2)
    )
    alone = Scanner(ring)
    for index, scan in enumerate(one):
        single = alone.scan(camera, views.view(index), hidden=True)
        for other in (two[index], again[index], single):
            for name in ARRAYS:
                np.testing.assert_array_equal(getattr(scan, name), getattr(other, name))
        np.testing.assert_array_equal(
            scan.camera_from_part.as_matrix(), views.camera_from_part.as_matrix()[index]
        )


def test_scan_views_names_the_view_that_sees_nothing(ring):
    views = hemisphere_viewpoints(ORIGIN, elevations_deg=[70], azimuths_deg=[0, 90], distance_mm=50)
    with pytest.raises(InputError, match=r"view 0 \(elevation 70 deg, azimuth 0 deg\).*near"):
        scan_views(ring, Camera(), views, progress=False)
    with pytest.raises(InputError, match="workers"):
        scan_views(ring, Camera(), views, workers=0)


def test_a_camera_sees_an_open_surface_from_both_sides() -> None:
    """A roof of two faces wound against each other: the normals face the camera all the same."""
    vertices = np.array([[-40.0, -30, 0], [40, -30, 0], [40, 30, 9], [-40, 30, 9]])
    faces = np.array([[0, 1, 2], [0, 3, 2]])
    roof = part_from_mesh(vertices, faces, name="roof", must_be_closed=False)
    up = np.cross([80.0, 0, 0], [0.0, 60, 9])
    up /= np.linalg.norm(up)
    for pose, side in ((ABOVE, 1), (look_at(np.array([5.0, 3.0, -400.0]), ORIGIN), -1)):
        scan = Scanner(roof).scan(Camera().scaled(0.25), pose)
        assert set(scan.face) == {0, 1}
        facing = np.tile(side * pose.rotate(up[None]), (len(scan.pixel), 1))
        np.testing.assert_allclose(scan.normals, facing, atol=1e-7)  # f32
        at_part = pose.inverse().apply(scan.points.astype(np.float64))
        np.testing.assert_allclose((at_part - vertices[0]) @ up, 0, atol=ROUNDING_MM)
