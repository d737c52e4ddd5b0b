"""Where in a measured blank the finished part lies, so that every face keeps its stock.

A small motion of the part changes the stock of all its surface linearly, so that the largest least
stock is a linear program, and the most even stock a least-squares problem with linear constraints.
Each is solved again at its result until the part stays where it is. Host code, float64, mm, rad.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.optimize import linprog, nnls
from scipy.spatial.transform import Rotation

from vanejax.cad.part import Part
from vanejax.errors import InputError
from vanejax.machine.measured_stock import (
    MOST_STOCK,
    FinishedSurface,
    StockMeter,
    finished_surface,
    measured_surface,
)
from vanejax.rigid import RigidTransform
from vanejax.scans.measured_scan import MeasuredScan

POINTS = 4000  # of the finished part's surface
AXES = ("rx", "ry", "rz", "x", "y", "z")  # of a motion, in this order
LEAST_SEEN = 0.05  # of the points: with fewer the scan is not one of this part
LOOKS = 8  # at which planes lie above the part, at most
STEPS = 30  # with the same planes, at most
FIRST_STEP_MM, LAST_STEP_MM = 1.0, 1e-4  # of the part's surface, farthest from its centre
FEASIBLE_MM = 1e-3  # short by less is not short
# of the stock won per mm of motion: what wins less stays where the registration has it
LEAST_GAIN = 0.02
SHORT_WEIGHT = 5.0  # of what is short over what is left: stock comes first
# a face is unopposed where a motion of at most 1 mm along each axis adds half of `GAIN_MM` to it
# and takes no more than `LOSS_MM` from any that was seen; such a motion costs more than it may win
GAIN_MM, LOSS_MM, UNOPPOSED_COST = 0.25, 0.05, 0.5
DIRECTION_POINTS = 800
LEAST_SHARE = 0.05  # of the multipliers: a side with less does not hold the part


@dataclasses.dataclass(frozen=True, eq=False)
class Placement:
    """A place of the finished part in a measured blank, and the stock that it leaves.

    The blank's frame is the CAD model's at the pose of the registration. Relative to the measured
    points the place is exact, as it is chosen: what is uncertain is the stock.

    Attributes:
      blank_from_part: how the part was moved in the blank.
      motion: [6], its rotation vector in rad and the shift of the part's centre in mm.
      part_from_camera: of each scan, the pose of the part as placed.
      points: [n, 3] mm, of the finished surface, uniform over its area, part frame.
      normals: [n, 3], unit, outward.
      stock_mm: [n], along the normals; NaN where no scan saw the blank.
      required_mm: [n], that must be left; NaN where a point does not count.
      sigma_mm: [n], standard deviation of the stock by the noise of the scan alone; NaN likewise.
      opposed: [n] bool, whether stock is known on the other side too: what is added here is seen to
        be taken there. Elsewhere the part is not moved farther than the required stock asks.
      held_by: the sides of the part that keep it from a better place, such as "+x", with their
        shares, the largest first; empty where the stock was evened.
      margin_sigma_mm: of `margin_mm`, by the noise of the scan at those places alone.
      converged: whether the part stayed in its place in the end.
    """

    blank_from_part: RigidTransform
    motion: np.ndarray
    part_from_camera: tuple[RigidTransform, ...]
    points: np.ndarray
    normals: np.ndarray
    stock_mm: np.ndarray
    required_mm: np.ndarray
    sigma_mm: np.ndarray
    opposed: np.ndarray
    held_by: tuple[tuple[str, float], ...]
    margin_sigma_mm: float
    converged: bool

    @property
    def least(self) -> int:
        """Which point has the least stock beyond what is required: there it runs out first."""
        return int(np.nanargmin(self.stock_mm - self.required_mm))

    @property
    def margin_mm(self) -> float:
        """The least stock beyond what is required, where it is known; negative: short by it."""
        return float(np.nanmin(self.stock_mm - self.required_mm))

    @property
    def is_feasible(self) -> bool:
        """Whether all that was seen keeps the required stock."""
        return self.margin_mm >= -FEASIBLE_MM

    @property
    def seen_share(self) -> float:
        """Of the surface that counts, that with known stock, 0 to 1."""
        counts = np.isfinite(self.required_mm)
        return float(np.count_nonzero(counts & np.isfinite(self.stock_mm)) / counts.sum())

    @property
    def unopposed_share(self) -> float:
        """Of the surface with known stock, that whose other side no scan saw, 0 to 1."""
        known = np.isfinite(self.stock_mm - self.required_mm)
        return float(np.mean(~self.opposed[known]))

    @property
    def least_side(self) -> str:
        """The side of the part with the point `least`, such as "+x"."""
        return side_name(self.normals[self.least])

    @property
    def reason(self) -> str:
        """The sentence that a verdict gives."""
        if self.is_feasible:
            return (
                f"feasible on what was seen ({self.seen_share:.0%} of the machined surface), with "
                f"at least {max(self.margin_mm, 0):.3f} mm more than required"
            )
        sides = " and ".join(name for name, _ in self.held_by) or self.least_side
        faces = "the faces that look" if " and " in sides else "the face that looks"
        return (
            f"no pose leaves the stock: short by {-self.margin_mm:.3f} mm on {faces} along {sides}"
        )


def side_name(normal: np.ndarray) -> str:
    """The axis that a normal [3] is nearest to: "+x" to "-z"."""
    axis = int(np.argmax(np.abs(normal)))
    return "+-"[int(normal[axis] < 0)] + "xyz"[axis]


def place(
    scans: Sequence[tuple[MeasuredScan, RigidTransform]],
    part: Part,
    required_mm: float | np.ndarray,
    *,
    even: bool = False,
    fixed: Sequence[str] = (),
) -> Placement:
    """The place of a finished part in a measured blank.

    Of all places, one that leaves the required stock on every face that was seen and, of these, the
    one with the largest least stock beyond it. Where there is none, the one that is short by the
    least. What no face decides stays as it was registered. A face whose other side no scan saw
    (`Placement.opposed`) gets the stock it must have, and no more: what it had beyond would be
    taken from a face that nobody saw.

    Args:
      scans: of the blank, each with its ``part_from_camera``, from a registration to ``part``.
      part: the finished part.
      required_mm: the stock that must be left, everywhere, or [POINTS] at the points of
        ``finished_surface(part, POINTS)``, NaN where it does not matter.
      even: the most even stock, of least variance, of the places with the required stock, in place
        of the largest least stock.
      fixed: of `AXES`, along and about which the part must not be moved: the part's axes as
        registered, through its centre.

    Raises:
      InputError: a required stock that is not finite, an unknown axis, all axes fixed, or too
        little of the part's surface with a measured blank above it.
    """
    finished = finished_surface(part, POINTS)
    required = np.asarray(required_mm, np.float64)
    if required.shape not in ((), (POINTS,)):
        raise InputError(
            f"the required stock must be one length or {POINTS}, got shape {list(required.shape)}"
        )
    required = np.broadcast_to(required, (POINTS,)).copy()
    if np.isinf(required).any() or not np.isfinite(required).any():
        raise InputError("the required stock must be a finite length in mm")
    free = _free_axes(fixed)
    meter = StockMeter(measured_surface(scans), finished)
    problem = _Problem(meter, part, required, free)
    motion, planes, step = np.zeros(6), np.full(POINTS, -1), np.inf
    for _ in range(LOOKS):
        # a plane that is no longer above its point holds it all the same: no face is lost
        found = meter.planes_above(problem.pose(motion), planes)
        planes = np.where(found >= 0, found, planes)
        problem.see(planes, motion)
        before, motion = motion, problem.largest_least()
        multipliers = problem.multipliers
        if even and problem.short_mm(motion) <= FEASIBLE_MM:
            motion, multipliers = problem.most_even(motion), None
        step = np.abs(problem.scale * (motion - before)).max()
        if step < LAST_STEP_MM:
            break
    return _result(problem, scans, motion, multipliers, converged=bool(step < LAST_STEP_MM))


def _free_axes(fixed: Sequence[str]) -> np.ndarray:
    """[6] bool."""
    for name in fixed:
        if name not in AXES:
            raise InputError(f"no axis {name!r} to fix; the axes are {', '.join(AXES)}")
    free = np.array([name not in fixed for name in AXES])
    if not free.any():
        raise InputError("all axes are fixed: nothing is left to place")
    return free


class _Problem:
    """The stock as a function of the motion, and its optima, with the planes that were seen."""

    def __init__(
        self, meter: StockMeter, part: Part, required: np.ndarray, free: np.ndarray
    ) -> None:
        self.meter, self.center = meter, part.center
        self.required, self.free = required, free
        self.rows = self.planes = np.zeros(0, np.int64)
        self.opposed = np.zeros(0, bool)
        self.scale = np.repeat([part.radius, 1.0], 3)  # a motion in mm of the part's surface
        self.farthest_mm = MOST_STOCK * part.radius
        self.unopposed: np.ndarray | None = None
        self.enough = np.zeros(6)  # the smallest motion with the required stock
        self.multipliers = np.zeros(0)

    def pose(self, motion: np.ndarray) -> RigidTransform:
        """blank_from_part of a motion [6] about the part's centre."""
        turn = Rotation.from_rotvec(motion[:3]).as_matrix()
        return RigidTransform(turn, self.center + motion[3:] - turn @ self.center)

    def see(self, planes: np.ndarray, motion: np.ndarray) -> None:
        """Takes the planes [n] above the part, -1 for none."""
        self.rows = np.flatnonzero((planes >= 0) & np.isfinite(self.required))
        if len(self.rows) < LEAST_SEEN * np.isfinite(self.required).sum():
            raise InputError(
                f"of {np.isfinite(self.required).sum():,} points of the part's surface only "
                f"{len(self.rows)} have a measured blank above them; is the scan one of this part, "
                "and the pose that of this scan?"
            )
        self.planes = planes[self.rows]
        _, change = self.margins(motion)
        if self.unopposed is None:
            self.unopposed = self._unopposed_motion(change)
            self.along = self.unopposed / max(np.linalg.norm(self.unopposed), 1e-12)
        self.opposed = change @ self.unopposed < GAIN_MM / 2
        if self.opposed.mean() < LEAST_SHARE:  # a few points at edges
            self.opposed[:] = False

    def margins(self, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Stock beyond what is required [m] mm, and its change [m, 6] per mm of scaled motion."""
        stock, change = self.meter.stock(
            self.rows, self.planes, self.pose(motion), self.center + motion[3:]
        )
        return stock - self.required[self.rows], change / self.scale

    def short_mm(self, motion: np.ndarray) -> float:
        """What is missing at the worst place, 0 for nothing."""
        return max(0.0, -float(self.margins(motion)[0].min()))

    def moved(self, motion: np.ndarray, step: np.ndarray) -> np.ndarray:
        """The motion [6] followed by a scaled step [6], exactly 0 along fixed axes."""
        turn = Rotation.from_rotvec(step[:3] / self.scale[:3]) * Rotation.from_rotvec(motion[:3])
        return np.where(self.free, np.concatenate([turn.as_rotvec(), motion[3:] + step[3:]]), 0.0)

    def largest_least(self) -> np.ndarray:
        """The motion [6] with the largest least margin; leaves its `multipliers`.

        First the smallest motion with the required stock everywhere; from there to the largest
        least stock of opposed faces, without a motion along what is unopposed.
        """
        self.enough = self._descend(self.enough, held=None)
        if not self.opposed.any() or self.short_mm(self.enough) > FEASIBLE_MM:
            return self.enough
        return self._descend(self.enough, held=self.scale * self.enough)

    def _descend(self, motion: np.ndarray, *, held: np.ndarray | None) -> np.ndarray:
        """From a motion [6] to where `_program` has no better step."""
        most, cost = FIRST_STEP_MM, self._cost(motion, held)
        for _ in range(STEPS):
            step, self.multipliers = self._program(motion, most, held)
            if np.abs(step).max() < LAST_STEP_MM:
                break
            after = self.moved(motion, step)
            if (new_cost := self._cost(after, held)) < cost - 1e-9:
                motion, cost = after, new_cost
            elif (most := most / 4) < LAST_STEP_MM:
                break
        return motion

    def _cost(self, motion: np.ndarray, held: np.ndarray | None) -> float:
        """What `_program` minimises, of a motion itself."""
        margin, _ = self.margins(motion)
        short = max(0.0, -float(margin.min()))
        off = self.scale * motion - (0 if held is None else held)
        cost = SHORT_WEIGHT * short + LEAST_GAIN * np.abs(off).sum()
        if held is None:
            return cost
        left = float(margin[self.opposed].min()) + short
        return cost - left + UNOPPOSED_COST * abs(self.along @ off)

    def _program(
        self, motion: np.ndarray, most: float, held: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """The best scaled step [6], no component above ``most``, and the rows' multipliers [m].

        Variables: the step [6], its sizes with the motion off ``held`` [6], that along what is
        unopposed, what is short, and what opposed rows have left. Without ``held`` [6] (a scaled
        motion), the last does not count, and the motion is that off the registered place.
        """
        margin, change = self.margins(motion)
        count, one = len(margin), np.eye(6)
        scaled = self.scale * motion
        off = scaled - (0 if held is None else held)
        left = self.opposed[:, None] * 1.0
        stock = np.hstack([-change, np.zeros((count, 7)), -np.ones((count, 1)), left])
        sizes = np.vstack([one, -one]), np.vstack([-one, -one]), np.zeros((12, 3))
        along = np.vstack([self.along, -self.along])
        beyond = np.hstack([along, np.zeros((2, 6)), [[-1.0, 0, 0], [-1.0, 0, 0]]])
        rows = np.vstack([stock, np.hstack(sizes), beyond])
        above = np.concatenate([margin, -off, off, -along @ off])
        cost = np.concatenate([np.zeros(6), np.full(6, LEAST_GAIN), [0.0, SHORT_WEIGHT, 0.0]])
        if held is not None:
            cost[[12, 14]] = UNOPPOSED_COST, -1.0
        bounds = [(0, None)] * 15
        for k in range(6):
            near = np.clip(
                [-most, most], -self.farthest_mm - scaled[k], self.farthest_mm - scaled[k]
            )
            bounds[k] = tuple(near * self.free[k])
        if held is None:
            bounds[14] = (0, 0)
        found = linprog(cost, rows, above, bounds=bounds, method="highs")
        if found.x is None:
            return np.zeros(6), np.zeros(count)
        return found.x[:6], -found.ineqlin.marginals[:count]

    def _unopposed_motion(self, change: np.ndarray) -> np.ndarray:
        """A scaled motion [6] that adds stock to as many faces as can be and takes it from none.

        Zero where there is none. It maximises the sum of ``min(gain, GAIN_MM)``, with no gain below
        ``-LOSS_MM``.
        """
        some = np.random.default_rng(0).permutation(len(change))[:DIRECTION_POINTS]
        change = change[some]
        count = len(change)
        rows = np.hstack([-change, change, np.eye(count)])
        cost = np.concatenate([np.full(12, LEAST_GAIN * count), -np.ones(count)])
        bounds = [(0.0, float(free)) for free in self.free] * 2
        bounds += [(-LOSS_MM, GAIN_MM)] * count
        found = linprog(cost, rows, np.zeros(count), bounds=bounds, method="highs")
        if found.x is None or -found.fun < LEAST_SHARE * GAIN_MM * count:
            return np.zeros(6)
        return found.x[:6] - found.x[6:12]

    def most_even(self, motion: np.ndarray) -> np.ndarray:
        """From a motion [6] with the required stock to that with the least variance of margins.

        Of opposed faces together, and of the unopposed ones of each side.
        """
        if not self.opposed.any():
            return motion
        # unopposed faces are even each by itself: to be like the others they would have to move
        normals = self.meter.finished.normals[self.rows]
        axis = np.argmax(np.abs(normals), axis=1)
        sides = 1 + 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] < 0)
        groups = np.where(self.opposed, 0, sides)
        for _ in range(STEPS):
            margin, change = self.margins(motion)
            uneven, rows = (
                _about_means(values, groups) / np.sqrt(len(groups)) for values in (margin, change)
            )
            stay = LEAST_GAIN * np.eye(6)
            toward = self.along[None] * UNOPPOSED_COST
            matrix = np.vstack([rows, stay, toward])[:, self.free]
            off = self.scale * (motion - self.enough)
            wanted = -np.concatenate([uneven, stay @ off, toward @ off])
            step = np.zeros(6)
            step[self.free] = _least_squares(matrix, wanted, change[:, self.free], -margin)
            step *= min(1.0, FIRST_STEP_MM / max(np.abs(step).max(), 1e-12))
            motion = self.moved(motion, step)
            if np.abs(step).max() < LAST_STEP_MM:
                break
        return motion


def _about_means(values: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Values [m, ...] less the mean of their group [m]."""
    values = values.copy()
    for group in np.unique(groups):
        values[groups == group] -= values[groups == group].mean(axis=0)
    return values


def _least_squares(
    matrix: np.ndarray, wanted: np.ndarray, rows: np.ndarray, least: np.ndarray
) -> np.ndarray:
    """The x [k] that minimises ``|matrix x - wanted|^2`` with ``rows x >= least``.

    By non-negative least squares (Lawson and Hanson, Solving Least Squares Problems, 1974, chapter
    23); of many constraints only those that bind are taken.
    """
    q, r = np.linalg.qr(matrix)
    start = np.linalg.solve(r, q.T @ wanted)
    x, taken = start, np.zeros(0, np.int64)
    for _ in range(STEPS):
        lacking = least - rows @ x
        worst = np.argsort(lacking)[-len(start) :]
        worst = np.setdiff1d(worst[lacking[worst] > 1e-9], taken)
        if not len(worst):
            break
        taken = np.concatenate([taken, worst])
        shortest = np.linalg.solve(r.T, rows[taken].T)
        lacking = least[taken] - rows[taken] @ start
        target = np.append(np.zeros(len(start)), 1.0)
        system = np.vstack([shortest, lacking])
        rest = system @ nnls(system, target)[0] - target
        if abs(rest[-1]) < 1e-12:  # they contradict each other
            return np.zeros_like(start)
        x = start + np.linalg.solve(r, -rest[:-1] / rest[-1])
    return x


def _result(
    problem: _Problem,
    scans: Sequence[tuple[MeasuredScan, RigidTransform]],
    motion: np.ndarray,
    multipliers: np.ndarray | None,
    *,
    converged: bool,
) -> Placement:
    pose, meter = problem.pose(motion), problem.meter
    finished: FinishedSurface = meter.finished
    known = np.full(POINTS, -1)
    known[problem.rows] = problem.planes
    planes = meter.planes_above(pose, known)
    seen = np.flatnonzero((planes >= 0) & np.isfinite(problem.required))
    if not len(seen):
        raise InputError("the part was moved to where no scan saw the blank: fix an axis")
    stock, sigma = np.full((2, POINTS), np.nan)
    stock[seen] = meter.stock(seen, planes[seen], pose, problem.center)[0]
    sigma[seen] = meter.sigma_mm(seen, planes[seen], pose)
    opposed = np.zeros(POINTS, bool)
    opposed[problem.rows] = problem.opposed
    least = int(np.nanargmin(stock - problem.required))
    held_by, margin_sigma = (), float(sigma[least])
    if multipliers is not None and multipliers.sum() > 0:
        weights = multipliers / multipliers.sum()
        held_by = _sides(finished.normals[problem.rows], weights)
        # points with the same plane have the same error
        of_plane = np.bincount(problem.planes, weights)
        errors = meter.sigma_mm(problem.rows, problem.planes, pose)
        of_plane_sigma = np.zeros(len(of_plane))
        of_plane_sigma[problem.planes] = errors
        margin_sigma = float(np.linalg.norm(of_plane * of_plane_sigma))
    part_from_blank = pose.inverse()
    return Placement(
        pose,
        motion,
        tuple(part_from_blank @ part_from_camera for _, part_from_camera in scans),
        finished.points,
        finished.normals,
        stock,
        problem.required,
        sigma,
        opposed,
        held_by,
        margin_sigma,
        converged,
    )


def _sides(normals: np.ndarray, weights: np.ndarray) -> tuple[tuple[str, float], ...]:
    """The sides with most of the weights [m] of points by their normals [m, 3]."""
    shares: dict[str, float] = {}
    for row in np.flatnonzero(weights > 0):
        name = side_name(normals[row])
        shares[name] = shares.get(name, 0.0) + float(weights[row])
    order = sorted(shares.items(), key=lambda item: -item[1])
    return tuple((name, share) for name, share in order if share > LEAST_SHARE)
