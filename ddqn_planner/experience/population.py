"""What all places of the world have in common, and how much they differ."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ddqn_planner.experience.places import NOISE, Float64, Places

# The variance of the log slowness of places, assumed from so many places before the
# first drive, and its limits.
VARIANCE = 1.0
ASSUMED_PLACES = 4.0
LEAST_VARIANCE = 0.05
MOST_VARIANCE = 2.0

# Neighbours are alike: this many places of a path tell as much of other places as one
# place alone.
ALIKE_PLACES = 8.0

# Before the first drive: the mean log slowness is 0 with this inverse variance, and the
# weight of the prior has this mean and inverse variance.
INVERSE_VARIANCE_OF_LEVEL = 2.0
PRIOR_WEIGHT = 0.2
INVERSE_VARIANCE_OF_PRIOR_WEIGHT = 1.0

FEW_PLACES = 16.0  # so many are assumed to have been driven where nothing was slow
SMALLEST_WEIGHT = 0.2  # of a place's visits, from which the place counts
KNOWN_WEIGHT = 0.7  # of a place's visits, from which the place is known
# Fewer known places say nothing about the robot's speed in the open.
SURE_PLACES = 20
OPEN_QUANTILE = 0.25
FASTEST_QUANTILE = 0.05

ITERATIONS = 3  # of the variance and the level, as each depends on the other


class Population(NamedTuple):
    """The distribution of the log slowness of places."""

    level: float  # the mean where the prior predicts 0
    prior_weight: float  # how much the prediction of the prior counts
    variance: float
    # Added to the log slowness of unknown places: the mean of an exponential is more
    # than the exponential of the mean, as far as drives have shown that places differ.
    surplus: float
    open_log: float  # log slowness in the open
    fastest_log: float  # log slowness where the robot is fastest


def population_of(places: Places) -> Population:
    """Return the distribution of the log slowness, fitted to places.

    The log slowness of a place is the logarithm of the time there over that at nominal
    speed. `places` has sums of what was seen at N places: for the M places that were
    visited, the log slowness is normal around a level plus the prediction of the prior
    times a weight. The level, this weight and the variance are fitted.
    """
    has_visits = places.weight >= SMALLEST_WEIGHT
    weight = places.weight[has_visits]  # (M,), as the following arrays
    mean_log = places.sum_of_log[has_visits] / weight  # of the visits of each place
    noise = NOISE / weight  # the variance of each mean, by visits that differ
    predicted = places.predicted[has_visits]
    level, prior_weight, variance = _fit(mean_log, noise, predicted)

    # The log of the mean of a lognormal is half of the variance above the mean of the
    # log. The surplus counts less while few places were visited.
    surplus = (variance + NOISE) / 2 * len(weight) / (FEW_PLACES + len(weight))
    # Quantiles over known places: the robot's speed in the open, and where it is
    # fastest. With few known places, both are the nominal speed.
    known_log = mean_log[weight >= KNOWN_WEIGHT]
    open_log = 0.0
    fastest_log = 0.0
    if len(known_log) >= SURE_PLACES:
        open_log = float(np.quantile(known_log, OPEN_QUANTILE))
        fastest_log = float(np.quantile(known_log, FASTEST_QUANTILE))
    return Population(level, prior_weight, variance, surplus, open_log, fastest_log)


def _fit(
    mean_log: Float64, noise: Float64, predicted: Float64
) -> tuple[float, float, float]:
    """Return the level, the weight of the prior, and the variance of M places.

    The log slowness of the places is normal, with this variance, around the level plus
    the weight times the prediction.

    Parameters
    ----------
    mean_log, noise : (M,) float64
        The mean log slowness of each place's visits, and the variance of this mean.
    predicted : (M,) float64
        The log slowness that the prior predicts for each place.
    """
    # (M, 2): the log slowness is about `design @ (level, prior_weight)`.
    design: Float64 = np.column_stack([np.ones(len(predicted)), predicted])
    variance = VARIANCE
    count = len(predicted) / ALIKE_PLACES  # the number of places that are not alike
    for _ in range(ITERATIONS):
        level, prior_weight = _regression(mean_log, design, variance + noise)
        residual: Float64 = mean_log - design @ (level, prior_weight)
        # The part of each square that is not noise. The mean is over these squares and
        # over ASSUMED_PLACES more, of the variance VARIANCE.
        squares = residual**2 - noise
        total: float = ASSUMED_PLACES * VARIANCE + squares.sum() / ALIKE_PLACES
        mean_square = total / (ASSUMED_PLACES + count)
        variance = float(np.clip(mean_square, LEAST_VARIANCE, MOST_VARIANCE))
    return level, prior_weight, variance


def _regression(
    log: Float64, design: Float64, variances: Float64
) -> tuple[float, float]:
    """Return the level and the weight of the prior, by Bayesian linear regression.

    The log slowness is about `design @ (level, prior_weight)`.

    Parameters
    ----------
    log, variances : (M,) float64
        The log slowness of each place, and its variance.
    design : (M, 2) float64
        Ones, and the log slowness that the prior predicts for each place.
    """
    # (2, M): the design times the inverse variance of each place. ALIKE_PLACES places
    # tell as much as one place alone.
    weighted: Float64 = design.T / variances / ALIKE_PLACES
    inverse_variances = INVERSE_VARIANCE_OF_LEVEL, INVERSE_VARIANCE_OF_PRIOR_WEIGHT
    precision: Float64 = np.diag(inverse_variances) + weighted @ design  # (2, 2)
    covariance = np.linalg.inv(precision)
    # The mean of the posterior of the weight. As always with normal distributions, it
    # is the covariance times the sum of all means that were assumed or measured, each
    # over its variance.
    assumed = [0, INVERSE_VARIANCE_OF_PRIOR_WEIGHT * PRIOR_WEIGHT]
    fitted_weight = float(covariance[1] @ (assumed + weighted @ log))
    # Few places may be slow by chance where the prior says so: the weight is less than
    # the fitted one by a standard error, as far as it follows from these places.
    variance_of_weight = covariance[1, 1]
    share_of_places = 1 - INVERSE_VARIANCE_OF_PRIOR_WEIGHT * variance_of_weight
    doubt = share_of_places * math.sqrt(variance_of_weight)
    prior_weight = max(fitted_weight - doubt, 0)

    # The level is fitted again, with this weight.
    inverse_variances_of_log = weighted[0]  # (M,)
    remaining_log = log - prior_weight * design[:, 1]
    sum_of_inverse = INVERSE_VARIANCE_OF_LEVEL + inverse_variances_of_log.sum()
    level = float(inverse_variances_of_log @ remaining_log / sum_of_inverse)
    return level, prior_weight
