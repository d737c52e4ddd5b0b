"""Which model of its deviations a scan prefers, and what pose remains when all are averaged.

The mean deviations y of patches of a scan (positive outside the CAD model) are taken as

    y = J delta + T theta + C gamma + f + noise

with a small motion delta [6] of the pose (nothing is known of it before), terms theta that a model
has or has not (uniform stock, scale, focal length), errors gamma of the sensor's calibration with
known deviations, and a Gaussian random field f: the form of the part that no term describes, or a
sensor's smooth error. Each model (which terms, which field, its amplitude and length, how much
noisier than white the noise is) has a marginal likelihood in closed form. The pose is the average
over all models, weighted by it: what looks like a motion under a likely model is counted as one.

Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 2.7 (explicit
basis functions) and chapter 5; Hoeting et al., Bayesian Model Averaging, Statistical Science 1999.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from vanejax.scans.robust_statistics import robust_sigma

TERMS = ("stock", "scale", "focal")  # mm; relative; relative
TERM_SIGMAS = np.array([0.5, 0.01, 0.003])  # before the scan is seen
MODELS_OF_TERMS = ((), (0,), (1,), (2,), (0, 1), (0, 2))
COST_OF_TERMS = (0.0, 2.0, 5.0)  # log prior odds against no, one and two terms
# of the part's radius
LENGTHS = (0.1, 0.2, 0.4, 0.8, 1.6)
# of the motion of a displacement field: how the pose of a bent part is meant is not that certain
LEFT_MOTION = 0.3
FACING_WIDTH = 0.1  # of 1 - cosine, between faces that share an offset
# amplitudes of the field, mm, where the noise is white
AMPLITUDES = np.geomspace(1e-3, 1.0, 13)
# of the stock, where there is any: its variation, and by what factor e that may be another
SHARE, SHARE_SIGMA, LEAST_STOCK_MM = 0.2, 1.1, 0.05
INFLATIONS = np.array([1, 1.6, 2.5, 4, 8, 16, 40, 100.0])  # of the noise's variance
COST_OF_INFLATION = 0.7  # log prior odds against each factor e of it
# the pose is known to this much of the radius, turned and moved, before
POSE_SIGMAS = (0.2, 0.1)
OUTLIER = 5.0  # standard deviations of a patch that all the others predict
MOST_OUTLIERS = 0.15  # of the patches
# an outlier is as likely anywhere within so many mm, and before it is seen one patch in 50 is one
OUTLIER_RANGE_MM, OUTLIER_SHARE = 4.0, 0.02
DOUBTFUL_MM = 0.05  # a field that is smaller explains no patch on another face
ROBUST_ITERATIONS, ROBUST_WIDTH = 20, 3.0  # in standard deviations


class Field(NamedTuple):
    """A kind of random field, and its length in radii of the part.

    ``form``: an offset along the normal that varies with the place. ``displacement``: the place
    itself is displaced, in all three directions alike. ``range``: the sensor's range is off.
    ``facing``: faces that look the same way have the same offset. ``none``: no field.
    """

    kind: str
    length: float = 0.0

    def covariance(self, patches: Patches, prior: Prior) -> np.ndarray:
        """[M, M] of an amplitude of 1 mm."""
        if self.kind == "none":
            return np.zeros((len(patches),) * 2)
        along = np.clip(patches.normals @ patches.normals.T, -1, 1)
        if self.kind == "facing":
            return np.exp((along - 1) / FACING_WIDTH)
        length_mm = self.length * prior.radius_mm
        near = _similarity(patches.positions, patches.positions, length_mm)
        if self.kind == "displacement":
            return near * along + self._without_motion(patches, prior.surface, length_mm)
        if self.kind == "range":
            return near * np.outer(patches.cosine, patches.cosine)
        return near

    def _without_motion(
        self, patches: Patches, surface: np.ndarray, length_mm: float
    ) -> np.ndarray:
        """[M, M] to be added where the field moves the part's surface [S, 3] nowhere as a whole.

        The motion that fits a displacement u of the surface best is ``c = G^-1 sum B^T u`` with
        ``B = d(displacement) / d(motion)`` and ``G = sum B^T B``: that is the pose's, by what the
        pose of a part that is bent means.
        """
        moves = ways_of_motion(surface)
        fit = np.linalg.solve(
            np.einsum("sij,sik->jk", moves, moves), moves.swapaxes(-1, -2)
        )  # [S, 6, 3]
        columns = np.cross(patches.positions, patches.normals)
        columns = np.concatenate([columns, patches.normals], axis=1)
        near = _similarity(patches.positions, surface, length_mm)
        both = np.einsum("ms,mi,ski->mk", near, patches.normals, fit, optimize=True)
        among = _similarity(surface, surface, length_mm)
        motion = np.einsum("ski,st,tli->kl", fit, among, fit, optimize=True)
        return (
            (1 + LEFT_MOTION**2) * columns @ motion @ columns.T
            - both @ columns.T
            - columns @ both.T
        )


def _similarity(first: np.ndarray, second: np.ndarray, length_mm: float) -> np.ndarray:
    """[M, N] between points [M, 3] and [N, 3], mm: 1 where they meet."""
    squared = np.sum((first[:, None] - second[None]) ** 2, axis=-1)
    return np.exp(-0.5 * squared / length_mm**2)


def ways_of_motion(points: np.ndarray) -> np.ndarray:
    """[n, 3, 6] W: a small motion m = (rotation vector, shift) moves points [n, 3] by ``W m``."""
    turns = np.cross(np.eye(3)[None], points[:, None, :]).swapaxes(-1, -2)
    return np.concatenate([turns, np.broadcast_to(np.eye(3), turns.shape)], axis=-1)


@dataclasses.dataclass(frozen=True, eq=False)
class Patches:
    """Means over M patches of a scan under one pose.

    Attributes:
      deviation_mm: [M], along the normal.
      weight: [M], 1 / mm^2: inverse variances if the noise is white.
      columns: [M, 9 + C]: by how much each parameter moves the deviations: a motion [6] as in
        `vanejax.localization.residuals`, the `TERMS`, and errors of calibration of one standard
        deviation each.
      positions, normals: [M, 3], part frame; mm from the part's centre, and unit.
      cosine: [M] of the angle of incidence.
    """

    deviation_mm: np.ndarray
    weight: np.ndarray
    columns: np.ndarray
    positions: np.ndarray
    normals: np.ndarray
    cosine: np.ndarray

    def __len__(self) -> int:
        return len(self.weight)

    def select(self, which: np.ndarray) -> Patches:
        """Some of them."""
        return Patches(*(getattr(self, f.name)[which] for f in dataclasses.fields(self)))


@dataclasses.dataclass(frozen=True, eq=False)
class Average:
    """What all models together say.

    Attributes:
      mean: [9 + C] motion, terms and errors of calibration, to be added to what they are.
      covariance: [9 + C, 9 + C] of them.
      term_probability: [3] that a term is there at all.
      field_probability: that there is a field.
      field: of the most probable model.
      amplitude_mm: of that field; 0 without one.
      outliers: [M] bool, patches that no model explains; they do not count.
    """

    mean: np.ndarray
    covariance: np.ndarray
    term_probability: np.ndarray
    field_probability: float
    field: Field
    amplitude_mm: float
    outliers: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Prior:
    """What is known before the scan.

    Attributes:
      radius_mm: of the part.
      surface: [S, 3] mm, points all over the part, from its centre.
      kinds: of fields that may be.
      stock_mm: the stock, if it is known and not estimated.
      form_tolerance_mm: two standard deviations of the part's form, if that is known.
    """

    radius_mm: float
    surface: np.ndarray
    kinds: tuple[str, ...] = ("form", "displacement", "range", "facing")
    stock_mm: float | None = None
    form_tolerance_mm: float | None = None

    def fields(self) -> Iterator[Field]:
        """Those that may be; none at all unless the form's tolerance is known."""
        if self.form_tolerance_mm is None:
            yield Field("none")
        for kind in self.kinds:
            for length in (0.0,) if kind == "facing" else LENGTHS:
                yield Field(kind, length)

    def log_odds(self, field: Field, amplitude_mm: np.ndarray, count: int) -> np.ndarray:
        """Of one of ``count`` fields and its amplitude."""
        if field.kind == "none":
            return np.zeros_like(amplitude_mm)
        each = np.full_like(amplitude_mm, -np.log(count * len(AMPLITUDES)))
        each[amplitude_mm > max(AMPLITUDES[-1], self.form_tolerance_mm or 0.0)] = -np.inf
        if self.form_tolerance_mm is not None and field.kind != "range":
            # as likely half as large as twice as large
            octaves = np.log2(amplitude_mm / (0.5 * self.form_tolerance_mm))
            return each - 0.5 * octaves**2
        return each

    def log_share(self, field: Field, amplitude_mm: np.ndarray, stock_mm: float) -> np.ndarray:
        """Log odds of an amplitude with stock: where there is much stock, it varies more."""
        if field.kind not in ("form", "displacement") or abs(stock_mm) < LEAST_STOCK_MM:
            return np.zeros_like(amplitude_mm)
        step = np.log(AMPLITUDES[1] / AMPLITUDES[0])
        even = np.log(len(AMPLITUDES) * step / (SHARE_SIGMA * np.sqrt(2 * np.pi)))
        return even - 0.5 * (np.log(amplitude_mm / (SHARE * abs(stock_mm))) / SHARE_SIGMA) ** 2

    def models_of_terms(self) -> Iterator[tuple[int, ...]]:
        """Which terms may be together."""
        for terms in MODELS_OF_TERMS:
            if self.stock_mm is None or 0 not in terms:
                yield terms


def average_models(patches: Patches, current: np.ndarray, prior: Prior) -> Average:
    """The average over all models, without patches that none of them explains.

    Args:
      patches: under a pose and terms that are about right.
      current: [3 + C] the terms and errors that are taken out of ``patches`` already.
      prior: what is known.
    """
    # a field that is large and short would explain patches that are on another face as well
    kept = np.ones(len(patches), bool)
    average, standard, evidence = _average(patches, current, prior)
    doubtful = average.amplitude_mm > DOUBTFUL_MM or np.abs(standard).max() > OUTLIER
    others = _on_most_faces(patches, current, prior) if doubtful else kept
    if not others.all():
        other = _average(patches.select(others), current, prior)
        by_outliers = np.log(OUTLIER_SHARE / OUTLIER_RANGE_MM) * np.count_nonzero(~others)
        if other[2] + by_outliers > evidence:
            kept, (average, standard, _) = others, other
    for _ in range(2):
        far = np.flatnonzero(kept)[np.abs(standard) > OUTLIER]
        order = np.argsort(-np.abs(standard[np.abs(standard) > OUTLIER]))
        far = far[order][: max(1, len(kept) // 20)]
        if not len(far) or np.count_nonzero(~kept) + len(far) > MOST_OUTLIERS * len(kept):
            break
        kept[far] = False
        average, standard, _ = _average(patches.select(kept), current, prior)
    return dataclasses.replace(average, outliers=~kept)


def _on_most_faces(patches: Patches, current: np.ndarray, prior: Prior) -> np.ndarray:
    """[M] bool: patches that parameters without a field explain, by a robust fit.

    Geman-McClure, with a kernel that narrows to the noise or to what most patches are off by.
    """
    columns = patches.columns.copy()
    columns[:, :3] /= prior.radius_mm
    sigmas = np.ones(columns.shape[1])
    sigmas[:6] = np.repeat(POSE_SIGMAS, 3) * prior.radius_mm
    sigmas[6:9] = TERM_SIGMAS
    parameters = -np.concatenate([np.zeros(6), current])
    parameters[6:9] += _absent(prior)
    if prior.stock_mm is not None:
        sigmas[6] = 1e-9
    known, middle = np.diag(sigmas**-2), sigmas**-2 * parameters
    deviation = patches.deviation_mm
    least = ROBUST_WIDTH * np.median(1 / np.sqrt(patches.weight))
    width = ROBUST_WIDTH * robust_sigma(deviation, axis=0) + least
    for _ in range(ROBUST_ITERATIONS):
        off = deviation - columns @ parameters
        width = max(min(0.8 * width, ROBUST_WIDTH * robust_sigma(off, axis=0)), least)
        weight = 1 / (1 + (off / width) ** 2) ** 2 / width**2
        information = columns.T @ (weight[:, None] * columns) + known
        parameters = np.linalg.solve(information, columns.T @ (weight * deviation) + middle)
    return np.abs(deviation - columns @ parameters) < 2 * width


class _Models(NamedTuple):
    """Models with one field and one set of terms: G amplitudes, P inflations, D parameters."""

    field: Field
    terms: tuple[int, ...]
    parameters: np.ndarray  # [D], which of the columns are estimated
    log_probability: np.ndarray  # [G, P]
    mean: np.ndarray  # [G, P, D]
    covariance: np.ndarray  # [G, P, D, D]
    amplitude_mm: np.ndarray  # [G, P]
    inflation: np.ndarray  # [P]


def _average(
    patches: Patches, current: np.ndarray, prior: Prior
) -> tuple[Average, np.ndarray, float]:
    """The average, by how many standard deviations each patch is off all the others' word [M].

    And the log of the probability density of the patches' deviations.
    """
    unit = np.ones(patches.columns.shape[1])
    unit[:3] = 1 / prior.radius_mm  # rotations count as the way they move the outermost point
    scaled = dataclasses.replace(patches, columns=patches.columns * unit)
    models = list(_models(scaled, current, prior))
    top = max(float(m.log_probability.max()) for m in models)
    total = sum(float(np.exp(m.log_probability - top).sum()) for m in models)
    mean = np.zeros(len(unit))
    second = np.diag(mean)
    term_probability, field_probability = np.zeros(3), 0.0
    for m in models:
        probability = np.exp(m.log_probability - top) / total
        term_probability[list(m.terms)] += probability.sum()
        field_probability += probability.sum() if m.field.kind != "none" else 0.0
        for at in zip(*np.nonzero(probability > 1e-6), strict=True):
            full, spread = _all_parameters(m, at, current, prior)
            mean += probability[at] * full
            second += probability[at] * (spread + np.outer(full, full))
    best = max(models, key=lambda m: m.log_probability.max())
    at = np.unravel_index(np.argmax(best.log_probability), best.log_probability.shape)
    average = Average(
        mean=mean * unit,
        covariance=(second - np.outer(mean, mean)) * np.outer(unit, unit),
        term_probability=term_probability,
        field_probability=float(field_probability),
        field=best.field,
        amplitude_mm=float(best.amplitude_mm[at]),
        outliers=np.zeros(len(patches), bool),
    )
    evidence = top + np.log(total) + 0.5 * np.log(patches.weight / (2 * np.pi)).sum()
    return average, _standard_residuals(scaled, best, at, current, prior), float(evidence)


def _models(patches: Patches, current: np.ndarray, prior: Prior) -> Iterator[_Models]:
    """All models, with their marginal likelihoods."""
    count, parameters = patches.columns.shape
    root = np.sqrt(patches.weight)
    whitened = root[:, None] * np.column_stack([patches.columns, patches.deviation_mm])
    fields = list(prior.fields())
    for field in fields:
        values, data, ratios = np.zeros(count), whitened, np.zeros(1)
        if field.kind != "none":
            covariance = field.covariance(patches, prior) * np.outer(root, root)
            values, vectors = np.linalg.eigh(covariance)
            data, ratios = vectors.T @ whitened, AMPLITUDES**2
        inverse = 1 / (1 + ratios[:, None] * np.maximum(values, 0))
        products = np.einsum("mi,gm,mj->gij", data, inverse, data, optimize=True)
        products = products[:, None] / INFLATIONS[None, :, None, None]
        log_volume = -np.log(inverse).sum(axis=1)[:, None] + count * np.log(INFLATIONS)
        amplitude = np.sqrt(ratios[:, None] * INFLATIONS)
        odds = prior.log_odds(field, amplitude, len(fields))
        odds = odds - COST_OF_INFLATION * np.log(INFLATIONS)
        for terms in prior.models_of_terms():
            used = np.array([*range(6), *(6 + k for k in terms), *range(9, parameters)])
            # [deviations] = [columns, deviations] @ start, terms that are not there set right
            start = np.zeros(parameters + 1)
            start[-1] = 1
            start[6:9] = current[:3] - _absent(prior)
            start[[6 + k for k in terms]] = 0
            precision, middle = np.zeros(len(used)), np.zeros(len(used))
            precision[:3], precision[3:6] = 1 / POSE_SIGMAS[0] ** 2, 1 / POSE_SIGMAS[1] ** 2
            precision[:6] /= prior.radius_mm**2
            inner = slice(6, 6 + len(terms))
            precision[inner] = 1 / TERM_SIGMAS[list(terms)] ** 2
            middle[inner] = -current[list(terms)]
            precision[6 + len(terms) :], middle[6 + len(terms) :] = 1, -current[3:]
            square = np.einsum("i,gpij,j->gp", start, products, start)
            gradient = np.einsum("gpij,j->gpi", products, start)[..., used] + precision * middle
            information = products[..., used, :][..., used] + np.diag(precision)
            spread = np.linalg.inv(information)
            mean = np.einsum("gpij,gpj->gpi", spread, gradient)
            misfit = square + middle @ (precision * middle) - np.sum(gradient * mean, axis=-1)
            occam = np.linalg.slogdet(information)[1] - np.log(precision[inner]).sum()
            likelihood = -0.5 * (log_volume + occam + misfit)
            likelihood += prior.log_share(field, amplitude, current[0] if 0 in terms else 0.0)
            yield _Models(
                field,
                terms,
                used,
                likelihood + odds - COST_OF_TERMS[len(terms)],
                mean,
                spread,
                amplitude,
                INFLATIONS,
            )


def _absent(prior: Prior) -> np.ndarray:
    """[3] the values of terms that a model does not have."""
    return np.array([prior.stock_mm or 0.0, 0.0, 0.0])


def _all_parameters(
    models: _Models, at: tuple[int, int], current: np.ndarray, prior: Prior
) -> tuple[np.ndarray, np.ndarray]:
    """All parameters [D] of one model, and their covariance.

    Terms that it does not have go to what they are without it.
    """
    full, used = np.zeros(6 + len(current)), models.parameters
    spread = np.diag(full)
    full[6:9] = _absent(prior) - current[:3]
    full[used] = models.mean[at]
    spread[np.ix_(used, used)] = models.covariance[at]
    return full, spread


def _standard_residuals(
    patches: Patches, best: _Models, at: tuple[int, int], current: np.ndarray, prior: Prior
) -> np.ndarray:
    """[M] how far each patch is from what all the others say, in standard deviations."""
    full, _ = _all_parameters(best, at, current, prior)
    covariance = best.amplitude_mm[at] ** 2 * best.field.covariance(patches, prior)
    covariance += np.diag(best.inflation[at[1]] / patches.weight)
    inverse = np.linalg.inv(covariance)
    rest = inverse @ (patches.deviation_mm - patches.columns @ full)
    return rest / np.sqrt(np.diag(inverse))
