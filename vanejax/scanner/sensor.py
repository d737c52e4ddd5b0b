"""A structured-light camera: what goes wrong in it, each with its unit, and three that are known.

A projector stands beside the camera, ``baseline_mm`` along the camera's +x; what it does not light
is not measured. The rest is triangulated: errors of the disparity in pixels become errors of the
depth that grow with its square (`range_errors`), and light that is too much or too little leaves
holes (`exposure`). Every effect has its own switch; `sensor_effects` has their functions.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from vanejax.errors import InputError
from vanejax.scanner.camera import Camera
from vanejax.scanner.exposure import REFERENCE_MM, Exposure
from vanejax.scanner.range_errors import Lens, Trueness
from vanejax.settings import bounded, check_fields, magnitude


def _rate(default: float) -> float:
    return bounded(default, lambda rate: 0 <= rate <= 1, "be a share from 0 to 1")


@dataclasses.dataclass(frozen=True)
class Sensor:
    """A structured-light camera; the defaults are an ideal one.

    Attributes:
      camera: intrinsics and clip planes.
      baseline_mm: from the camera to the projector, along the camera's +x (negative: to its left).
      shadow: whether what the projector does not see is left out.
      max_incidence_deg: surfaces seen flatter are not measured; 90 for no limit.
      incidence_spread_deg: standard deviation of that limit from place to place, smooth over
        ``correlation_px``.
      exposure: light and shine; None: every surface is bright enough and none too bright.
      noise_px: standard deviation of the disparity, white; at `Exposure.reference_signal` if there
        is an exposure.
      correlated_px: standard deviation of an error of the disparity that is smooth in the image,
        and new in every scan.
      correlation_px: its length, see `range_errors.smooth_field`.
      window_px: the matching window of a stereo camera, as the standard deviation of a Gaussian: it
        rounds edges off, see `range_errors.window_mean`; 0 for a camera that codes single pixels.
      edge_fattening_px: standard deviation, in columns and in rows, of how far beside its pixel the
        texture lies that a window matched; smooth over ``correlation_px``. The error grows with the
        slope of the surface.
      border_dropout_px: mean width of the strip along the part's outline that finds no match; it
        varies as the correlated error does, see `range_errors.near_outline`.
      flying_pixel_rate: of the places where the depth jumps, those where a pixel mixes both sides.
      jump_mm: what difference of neighbouring depths is a jump.
      disparity_quantisation_px: disparities are rounded to multiples of it; 0 for none.
      depth_quantisation_mm: depths are rounded to multiples of it; 0 for none.
      lens: what calibration leaves of the lens; None for nothing.
      trueness: what it leaves of the depth; None for nothing.
      dropout_rate: of the pixels, lost singly.
      outlier_rate: of the measured points, those that lie anywhere within ``outlier_mm`` of depth.
      outlier_mm: largest error of an outlier.

    A value that no sensor can have raises InputError.
    """

    camera: Camera = dataclasses.field(default_factory=Camera)
    baseline_mm: float = bounded(120.0, lambda x: math.isfinite(x) and x, "be a length, not 0")
    shadow: bool = False
    max_incidence_deg: float = bounded(90.0, lambda deg: 0 < deg <= 90, "lie in (0, 90]")
    incidence_spread_deg: float = magnitude(0.0)
    exposure: Exposure | None = None
    noise_px: float = magnitude(0.0)
    correlated_px: float = magnitude(0.0)
    correlation_px: float = bounded(16.0, lambda px: 1 <= px < math.inf, "be 1 or more")
    window_px: float = magnitude(0.0)
    edge_fattening_px: float = magnitude(0.0)
    border_dropout_px: float = magnitude(0.0)
    flying_pixel_rate: float = _rate(0.0)
    jump_mm: float = magnitude(2.0)
    disparity_quantisation_px: float = magnitude(0.0)
    depth_quantisation_mm: float = magnitude(0.0)
    lens: Lens | None = None
    trueness: Trueness | None = None
    dropout_rate: float = _rate(0.0)
    outlier_rate: float = _rate(0.0)
    outlier_mm: float = magnitude(20.0)

    def __post_init__(self) -> None:
        check_fields(self, "sensor")

    @property
    def focal_baseline(self) -> float:
        """Focal length times baseline, pixels times mm: the depth times the disparity."""
        return self.camera.fx * abs(self.baseline_mm)

    def range_sigma_mm(self, depth_mm: float) -> float:
        """Standard deviation of the depth that ``noise_px`` makes: ``z^2 / (f b) noise_px``."""
        return depth_mm**2 / self.focal_baseline * self.noise_px

    def scaled(self, factor: float) -> Sensor:
        """The same errors in mm with ``factor`` times the pixels per side."""
        camera = self.camera.scaled(factor)
        factor = camera.width / self.camera.width
        changes = {
            field.name: factor * getattr(self, field.name)
            for field in dataclasses.fields(self)
            if field.name.endswith("_px")
        }
        changes["correlation_px"] = max(1.0, changes["correlation_px"])
        if self.lens is not None:
            center_error_px = tuple(factor * value for value in self.lens.center_error_px)
            changes["lens"] = dataclasses.replace(self.lens, center_error_px=center_error_px)
        return dataclasses.replace(self, camera=camera, **changes)

    def only(self, *names: str) -> Sensor:
        """The same camera with the effects of these fields alone; an ideal one without any."""
        kept = ("camera", "baseline_mm", "jump_mm", "correlation_px", *names)
        return Sensor(**{name: getattr(self, name) for name in kept})

    def exposed_for(self, distance_mm: float) -> Sensor:
        """The same with the exposure that a part at this distance needs.

        An exposure that suits 400 mm is longer by the square of the distance: the projector's light
        spreads.
        """
        if self.exposure is None:
            return self
        factor = (distance_mm / REFERENCE_MM) ** 2
        longer = dataclasses.replace(self.exposure, exposure_ms=factor * self.exposure.exposure_ms)
        return dataclasses.replace(self, exposure=longer)

    def sample(self, rng: np.random.Generator) -> Sensor:
        """Another camera of this kind, as its maker's next one would be.

        Errors of calibration are normally distributed with this sensor's as standard deviations;
        all other magnitudes, light and finish of the surface among them, are multiplied by the
        exponential of a normal number of standard deviation 0.3. Settings of the matching, such as
        its window, stay.
        """

        def vary(value: float) -> float:
            return value * math.exp(0.3 * rng.standard_normal())

        def normal(value: float) -> float:
            return value * rng.standard_normal()

        changes = {}
        if (light := self.exposure) is not None:
            changes["exposure"] = dataclasses.replace(
                light,
                exposure_ms=vary(light.exposure_ms),
                ambient_per_ms=vary(light.ambient_per_ms),
                ambient_towards=(*rng.standard_normal(2), abs(rng.standard_normal()) + 0.3),
                specular=min(1.0, vary(light.specular)),
                roughness=vary(light.roughness),
            )
        if (lens := self.lens) is not None:
            changes["lens"] = Lens(
                *(normal(value) for value in (lens.k1, lens.k2, lens.p1, lens.p2)),
                focal_error=normal(lens.focal_error),
                center_error_px=tuple(normal(value) for value in lens.center_error_px),
            )
        if (bias := self.trueness) is not None:
            changes["trueness"] = Trueness(
                scale=normal(bias.scale), bend_mm=tuple(normal(value) for value in bias.bend_mm)
            )
        changes |= {name: vary(getattr(self, name)) for name in ("noise_px", "correlated_px")}
        changes["correlation_px"] = max(1.0, vary(self.correlation_px))
        for name in ("flying_pixel_rate", "dropout_rate", "outlier_rate"):
            changes[name] = min(1.0, vary(getattr(self, name)))
        return dataclasses.replace(self, **changes)


def paper_camera() -> Sensor:
    """The structured-light camera of the paper's Table 2, good to 0.1 mm at 300 and 1 at 1300 mm.

    That is read as a bound on 95 % of the errors, noise and trueness together; what the table does
    not say (baseline, light, calibration) is usual for such cameras. Its near clip plane is at
    200 mm, not at the 300 of the working range: a renderer's clip plane cuts the part open, which
    no camera does.
    """
    return Sensor(
        camera=dataclasses.replace(Camera(), near_mm=200.0),
        baseline_mm=120.0,
        shadow=True,
        max_incidence_deg=78.0,
        exposure=Exposure(),
        noise_px=0.05,
        correlated_px=0.02,
        correlation_px=16.0,
        flying_pixel_rate=0.5,
        disparity_quantisation_px=1 / 64,
        lens=Lens(k1=1e-3, k2=1e-3, p1=1e-4, p2=1e-4, focal_error=1e-4, center_error_px=(0.1, 0.1)),
        trueness=Trueness(scale=1e-4, bend_mm=(0.02, 0.02)),
        dropout_rate=2e-3,
        outlier_rate=5e-4,
    )


def consumer_depth() -> Sensor:
    """A short-range stereo depth camera, in steps of 1 mm.

    The focal length is that of the pixel grid of 15 real scans; the magnitudes are those for which
    virtual scans of the same parts in the same poses have residuals, steps and holes most alike
    (`experiments.sensor_fit`, on every other scan; docs/real_scans.md). The baseline is that of
    such a camera.
    """
    width, height, focal = 424, 240, 212.945
    opening = [math.degrees(2 * math.atan(size / (2 * focal))) for size in (width, height)]
    return Sensor(
        camera=Camera(width, height, *opening, near_mm=50.0),
        baseline_mm=18.0,
        shadow=True,
        max_incidence_deg=76.0,
        incidence_spread_deg=10.0,
        noise_px=0.005,
        correlated_px=0.044,
        correlation_px=14.0,
        window_px=2.6,
        edge_fattening_px=1.1,
        border_dropout_px=0.87,
        flying_pixel_rate=0.5,
        jump_mm=10.0,
        depth_quantisation_mm=1.0,
        dropout_rate=0.017,
    )


PRESETS = {"ideal": Sensor, "paper_camera": paper_camera, "consumer_depth": consumer_depth}


def preset(name: str) -> Sensor:
    """The sensor of a name in `PRESETS`; InputError if there is none."""
    if name not in PRESETS:
        raise InputError(f"no sensor {name!r}; there are {', '.join(PRESETS)}")
    return PRESETS[name]()
