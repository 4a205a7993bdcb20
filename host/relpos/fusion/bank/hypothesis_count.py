"""How many hypotheses are needed: one where the posterior is near a Gaussian, else more.

A mixture may be replaced by its moments where that loses nothing: where everything that the
joint filter linearises is nearly a line within what is not known. Two things are not, a
displacement's direction and a range, and both are curved by a length that follows from the
mixture's covariance alone, beside noise that it is to be negligible against:

* a pair of users at distance d whose difference has the variance c across the line of sight
  lies on an arc, which is off its tangent by c / (2 d), against a range's sigma_r;
* a user whose heading has the deviation sigma_theta and whose place, as seen from its nearest user,
  has sigma_p has come there on an arc of length sigma_p, which is off its tangent by
  sigma_p sigma_theta / 2, against sigma_r;
* the next metre of its way will be shorter by sigma_theta^2 / 2 than it is long, against the
  noise sigma_l of a metre's length.

The greatest of the three ratios is the *nonlinearity index*. It counts together with whether the
hypotheses lie apart by more than what was drawn of the noise accounts for.
"""

from __future__ import annotations

import math

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.bank.storage import PER_NODE
from relpos.fusion.compiled import compiled, inner

STEPS = (50, 10, 1)
"""The bank shrinks by one of these at a time."""

LINEAR = 0.2
"""Greatest nonlinearity index of an unambiguous mixture."""

NONLINEAR = 0.4
"""From this index on there are as many hypotheses as may be; between the two nothing changes."""

STRONGLY_NONLINEAR, LESS_NONLINEAR = 1.0, 0.7
"""From this index on there are ``MORE`` times as many hypotheses, until it falls below the second.

From 1 on, what is not known lies on an arc that is off its tangent by a range's whole deviation
and more: no Gaussian covers it, and what two users do not know multiplies. In the middle of a run
the index of pairs and ways is 0.2 in P and P1, and 1.2 to 2.5 in H, H2 and ``lab``."""

MORE = 8
"""``paper-h2``, seeds 9100 to 9159: 200 hypotheses 1.41 m (worst 2.80), 400 1.39 (2.46), 800 while
strongly nonlinear 1.31 (1.76), 1600 1.28 (1.64); the bound is 1.30. There the bank then takes 6 ms
an epoch of 2 s, in place of 2."""

WORK = 1.6e8
"""Hypotheses times entries cubed at most (what an epoch costs, where every user ranges a few): six
people with biases of all pairs have 961 of 55 entries, ten without 640, twenty the usual 200."""

CHECKED_AFTER = 4
"""The strong nonlinearity is checked after so many instants of ranges."""

HELD = 10
"""The mixture has to be unambiguous for so many instants of ranges before each step."""

APART = 3.0
"""Between-hypothesis variance in units of what the drawn share accounts for, at most."""

EVEN = 0.1
"""Least share of the hypotheses that count (effective sample size over K)."""

UNDECIDED = 0.05
"""Greatest weight of the lesser side where some model constants or biases and others do not."""

KNOWN = 0.4
"""Greatest deviation of the logarithm of the range variance, as far as it is learned.

Both keep the bank as it is in the beginning: without them the recordings of two robots, whose
starts are known exactly, went to one before scales and biases were, and lost a third."""

PERTURBED_MOST = 0.1
"""Greatest weight of perturbed hypotheses."""


def sampled_share(share: float, count: int, most: int) -> float:
    """Share of the heading noise that ``count`` hypotheses draw, where ``most`` draw ``share``.

    Few draws of much noise are noise themselves: it goes with log K, and one alone draws none.
    """
    if count <= 1 or most <= 1:
        return 0.0
    return min(share, 0.9) * min(math.log(count) / math.log(most), 1.0)


def most(usual: int, size: int) -> int:
    """How many hypotheses of ``size`` entries there may be at the most; ``usual`` at the least."""
    return max(min(MORE * usual, int(WORK / size**3)), usual)


@inner
def _difference(
    mean: Floats, covariance: Floats, a: int, b: int
) -> tuple[float, float, float, float, float]:
    """Return where user ``b`` is from ``a``, east and north, and its covariance xx, yy, xy."""
    i, j = PER_NODE * a, PER_NODE * b
    xx = covariance[i, i] + covariance[j, j] - 2.0 * covariance[i, j]
    yy = covariance[i + 1, i + 1] + covariance[j + 1, j + 1] - 2.0 * covariance[i + 1, j + 1]
    xy = covariance[i, i + 1] + covariance[j, j + 1] - (covariance[i, j + 1] + covariance[i + 1, j])
    return mean[j] - mean[i], mean[j + 1] - mean[i + 1], xx, yy, xy


@compiled
def nonlinearity_index(
    mean: Floats, covariance: Floats, sigma_range_m: float, sigma_metre_m: Floats
) -> float:
    """Return the nonlinearity index of a mixture with the moments (D,) and (D, D).

    ``sigma_metre_m`` (N,) is how noisy the length of a metre is that each user walks.
    """
    nodes = sigma_metre_m.shape[0]
    greatest, shorter = 0.0, 0.0
    nearest = np.full(nodes, np.inf)
    for a in range(nodes):
        for b in range(a + 1, nodes):
            ux, uy, xx, yy, xy = _difference(mean, covariance, a, b)
            distance2 = max(ux * ux + uy * uy, 1e-6)
            across = (uy * uy * xx - 2.0 * ux * uy * xy + ux * ux * yy) / distance2
            greatest = max(greatest, max(across, 0.0) / (2.0 * math.sqrt(distance2)))
            place = max(xx + yy, 0.0)
            nearest[a], nearest[b] = min(nearest[a], place), min(nearest[b], place)
    for a in range(nodes):
        heading = max(covariance[PER_NODE * a + 2, PER_NODE * a + 2], 0.0)
        shorter = max(shorter, 0.5 * heading / sigma_metre_m[a])
        if nodes > 1:
            greatest = max(greatest, 0.5 * math.sqrt(nearest[a] * heading))
    return max(greatest / sigma_range_m, shorter)


def thinned(
    x: Floats, mean: Floats, covariance: Floats, chosen: Indices, angles: Indices, kept: float
) -> tuple[Floats, Floats]:
    """Give fewer hypotheses (M, D) with one covariance (D, D), and the same moments in all.

    ``mean`` and ``covariance`` are the mixture's, ``chosen`` (M,) the hypotheses drawn of ``x``
    (K, D), ``kept`` the share of the variance between them that stays between them.
    """
    off = x[chosen] - mean
    off[:, angles] = np.remainder(off[:, angles] + math.pi, 2.0 * math.pi) - math.pi
    off -= off.mean(axis=0)
    between = off.T @ off / len(chosen)
    while kept > 1e-3:
        rest = covariance - kept * between
        scale = np.sqrt(np.maximum(covariance.diagonal(), 1e-18))
        if np.linalg.eigvalsh(rest / np.outer(scale, scale))[0] > -1e-9:
            return mean + math.sqrt(kept) * off, rest
        # The few that were drawn happen to lie farther apart than all of them do.
        kept *= 0.5
    return np.repeat(mean[None], len(chosen), axis=0), covariance.copy()


def parted(
    x: Floats, p: Floats, angles: Indices, share: float, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Draw the headings of hypotheses (K, D), (K, D, D): ``share`` of their variance.

    All that is correlated with them goes along: of P, share P_:h P_hh^-1 P_h: is drawn and the
    rest stays in the covariance. The draws are centred and made white, so that the moments of
    copies of one hypothesis are those it had.
    """
    count, headings = len(x), len(angles)
    if not headings or share <= 0.0:
        return x, p
    drawn = rng.standard_normal((count, headings))
    drawn -= drawn.mean(axis=0)
    if count > 2 * headings:
        drawn = np.linalg.solve(np.linalg.cholesky(drawn.T @ drawn / count), drawn.T).T
    own = p[:, angles[:, None], angles] + 1e-12 * np.eye(headings)
    factor = np.linalg.cholesky(own)
    # P_:h L^-T, so that its square is what the headings account for.
    root = np.linalg.solve(factor, p[:, angles, :]).transpose(0, 2, 1)
    moved = x + math.sqrt(share) * np.einsum("kdh,kh->kd", root, drawn)
    return moved, p - share * root @ root.transpose(0, 2, 1)
