"""The filter of tracking: the paper's equations against other ways to the same numbers."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from gis_radar.calibration import CYCLE_S, DRIFT
from gis_radar.calibration.monitoring.kalman_filter import (
    LEVER,
    Estimate,
    Innovation,
    Measurement,
    corrected,
    covariance_from_angles,
    innovation,
    likeliest_move,
    predicted,
    widened,
)
from gis_radar.calibration.monitoring.moves import FALSE_ALARMS, LENGTHS_S, MOVE_GATE, SUSPECT
from gis_radar.poses import Pose

HOUR_S = 3600.0
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


def positive(rng, sigma=(0.2, 0.2, 0.2, 0.004, 0.004, 0.004)):
    """A covariance with all its correlations."""
    root = rng.normal(0, 1, (6, 8)) / np.sqrt(8) * np.array(sigma)[:, None]
    return root @ root.T + np.diag(np.square(sigma)) * 0.05


def estimate(rng, **changes):
    fields = {
        "time": 0.0,
        "position": rng.normal(0, 1, 3),
        "quaternion": Rotation.random(rng=rng).as_quat(canonical=True),
        "covariance": positive(rng),
    }
    return Estimate(**(fields | changes))


def measured(rng, of, *, share=1.0, covariance=None, gap=None):
    covariance = positive(rng) if covariance is None else covariance
    gap = rng.multivariate_normal(np.zeros(6), covariance) if gap is None else gap
    turn = Rotation.from_rotvec(gap[3:]) * Rotation.from_quat(of.quaternion)
    return Measurement(
        position=of.position + gap[:3],
        quaternion=turn.as_quat(),
        covariance=covariance,
        noise=share * covariance,
    )


def test_without_a_common_error_it_is_the_textbook_filter():
    rng = np.random.default_rng(1)
    now = estimate(rng, quaternion=LEVEL)
    x, p = np.array([*now.position, 0.0, 0.0, 0.0]), now.covariance
    sigma = (0.2, 0.2, 0.2, 4e-5, 4e-5, 4e-5)  # so small that turns add up like numbers
    for k in range(40):
        seen = measured(rng, now, covariance=positive(rng, sigma))
        z = np.array([*seen.position, *Rotation.from_quat(seen.quaternion).as_rotvec()])
        now = corrected(predicted(now, 5.0 * (k + 1)), seen)
        p = p + np.diag(np.square(DRIFT) * 5.0 / HOUR_S)
        information = np.linalg.inv(p) + np.linalg.inv(seen.covariance)
        x = np.linalg.solve(
            information, np.linalg.solve(p, x) + np.linalg.solve(seen.covariance, z)
        )
        p = np.linalg.inv(information)
    assert np.allclose(now.position, x[:3], atol=1e-6)
    assert np.allclose(Rotation.from_quat(now.quaternion).as_rotvec(), x[3:], atol=1e-8)
    assert np.allclose(now.covariance / np.outer(LEVER, LEVER), p / np.outer(LEVER, LEVER))


def test_equal_measurements_of_a_turn_come_to_the_mean_quaternion():
    rng = np.random.default_rng(2)
    truth = Rotation.random(rng=rng)
    turns = Rotation.from_rotvec(rng.normal(0, 0.02, (30, 3))) * truth
    now = estimate(rng, quaternion=turns[0].as_quat(), covariance=1e6 * np.eye(6))
    for turn in turns:
        sign = rng.choice([-1.0, 1.0])
        seen = Measurement(
            position=np.zeros(3), quaternion=sign * turn.as_quat(), covariance=np.eye(6) * 1e-4,
            noise=np.eye(6) * 1e-4,
        )  # fmt: skip
        now = corrected(now, seen)
    apart = Rotation.from_quat(now.quaternion).inv() * turns.mean()
    assert apart.magnitude() < 1e-4


def test_what_all_measurements_share_does_not_average_out():
    rng = np.random.default_rng(3)
    covariance = positive(rng)
    now = estimate(rng, covariance=np.eye(6) * 100.0)
    for _ in range(2000):
        now = corrected(now, measured(rng, now, covariance=covariance, share=0.3))
    assert np.allclose(now.covariance, 0.7 * covariance, rtol=0.01, atol=1e-3 * covariance.max())


def test_the_covariance_is_that_of_the_errors():
    """Many filters with one gain each, their errors drawn: common error and noise apart."""
    rng = np.random.default_rng(4)
    covariances = [positive(rng) for _ in range(6)]
    start = positive(rng)
    now = estimate(rng, quaternion=LEVEL, covariance=start)
    draws = 40_000
    error = rng.multivariate_normal(np.zeros(6), start, draws)  # truth less estimate
    common = rng.normal(0, 1, (draws, 6))
    for covariance in covariances:
        seen = measured(rng, now, covariance=covariance, share=0.4, gap=np.zeros(6))
        gain = np.linalg.solve(
            innovation(now, seen).covariance,
            (now.covariance + now.common @ seen.common.T).T,
        ).T
        noise = rng.multivariate_normal(np.zeros(6), 0.4 * covariance, draws)
        error = error - (error + common @ seen.common.T + noise) @ gain.T
        now = corrected(now, seen)
    scale = np.sqrt(np.diag(now.covariance))
    drawn = error.T @ error / draws / np.outer(scale, scale)
    assert np.allclose(drawn, now.covariance / np.outer(scale, scale), atol=0.03)
    assert np.allclose(error.T @ common / draws / scale[:, None], now.common / scale[:, None],
                       atol=0.03)  # fmt: skip


def test_the_innovation_has_the_spread_that_it_says():
    rng = np.random.default_rng(5)
    distances = []
    for _ in range(400):
        prior, covariance = positive(rng), positive(rng)
        truth = estimate(rng, covariance=prior)
        start = measured(rng, truth, covariance=prior)
        now = replace(truth, position=start.position, quaternion=start.quaternion)
        distances.append(innovation(now, measured(rng, truth, covariance=covariance)).chi2)
    assert np.mean(distances) == pytest.approx(6.0, abs=0.6)


def test_without_data_the_pose_stays_and_its_error_grows():
    rng = np.random.default_rng(6)
    now = estimate(rng)
    later = predicted(now, 4 * HOUR_S)
    assert np.array_equal(later.position, now.position)
    assert np.array_equal(later.quaternion, now.quaternion)
    assert np.allclose(np.diag(later.covariance - now.covariance), 4 * np.square(DRIFT))
    stepped = now
    for k in range(48):
        stepped = predicted(stepped, (k + 1) * HOUR_S / 12)
    assert np.allclose(stepped.covariance, later.covariance)
    assert np.array_equal(predicted(later, 0.0).covariance, later.covariance)


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.floats(0.05, 1.0), st.integers(1, 12))
def test_estimates_stay_sound(seed, share, cycles):
    rng = np.random.default_rng(seed)
    now = estimate(rng, quaternion=rng.choice([-1, 1]) * Rotation.random(rng=rng).as_quat())
    for k in range(cycles):
        seen = measured(rng, now, share=share)
        flipped = replace(seen, quaternion=-seen.quaternion)
        before = predicted(now, 5.0 * k)
        now = corrected(before, seen)
        other = corrected(before, flipped)
        assert np.allclose(now.quaternion, other.quaternion, atol=1e-12)
        assert np.linalg.norm(now.quaternion) == pytest.approx(1.0, abs=1e-12)
        assert now.quaternion @ before.quaternion >= 0.0
        assert np.array_equal(now.covariance, now.covariance.T)
        scale = 1.0 / np.sqrt(np.diag(now.covariance))
        assert np.linalg.eigvalsh(now.covariance * np.outer(scale, scale))[0] > 0.0
        assert np.trace(now.covariance * np.outer(LEVER, LEVER)) < np.trace(
            before.covariance * np.outer(LEVER, LEVER)
        )


@settings(max_examples=40)
@given(st.floats(-179, 179), st.floats(-70, 70), st.floats(-179, 179), st.integers(0, 99))
def test_angles_and_turns_have_one_covariance(yaw, pitch, roll, seed):
    pose = Pose(
        sensor="R", crs=25832, easting=0.0, northing=0.0, height=0.0, yaw=yaw, pitch=pitch,
        roll=roll,
    )  # fmt: skip
    covariance = positive(np.random.default_rng(seed))
    turned = covariance_from_angles(pose.quaternion, covariance)
    back = estimate(np.random.default_rng(0), quaternion=pose.quaternion, covariance=turned)
    assert np.allclose(back.angle_covariance, covariance, rtol=1e-6, atol=1e-12)


def test_what_windows_share_hides_no_move():
    """A move is held against noise alone: what the windows share cancels in their difference."""
    rng = np.random.default_rng(7)
    now = estimate(rng, quaternion=LEVEL, covariance=np.eye(6) * 100.0)
    covariance = np.diag(np.square([0.2, 0.2, 0.2, 4e-3, 4e-3, 4e-3]))
    first = measured(rng, now, covariance=covariance, share=0.1, gap=np.zeros(6))
    now = corrected(now, first)
    move = np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    after = measured(rng, now, covariance=covariance, share=0.1, gap=move)
    # 0.5 m against twice the variance of the noise, not of the whole
    assert innovation(now, after).chi2 == pytest.approx(0.25 / (2 * 0.1 * 0.04), rel=0.02)
    assert now.covariance[0, 0] == pytest.approx(0.04, rel=0.01)


def test_a_pose_that_may_have_moved_is_less_certain():
    rng = np.random.default_rng(8)
    now = estimate(rng)
    move = np.array([0.8, -0.3, 0.1, 0.002, 0.0, 0.02])
    wide = widened(now, move)
    assert move @ np.linalg.solve(wide.covariance, move) == pytest.approx(1.0)
    assert np.linalg.eigvalsh(wide.covariance - now.covariance)[0] > -1e-12
    again = widened(wide, move)  # a doubt that lasts does not add up
    assert np.allclose(again.covariance, wide.covariance)
    assert widened(now, 1e-3 * move) is now


def test_the_likeliest_move_leaves_out_what_is_not_seen():
    covariance = np.diag(np.square([0.1, 100.0, 0.1, 1e-3, 1e-3, 1e-3]))
    found = Innovation(gap=np.array([0.5, 50.0, 0.0, 0.0, 0.0, 0.0]), covariance=covariance)
    move = likeliest_move(found)
    assert move[0] == pytest.approx(0.49, abs=0.01)
    assert abs(move[1]) < 0.01


def test_gates_are_quantiles_of_chi2():
    tests = 3600.0 / CYCLE_S * len(LENGTHS_S)
    assert pytest.approx(chi2.ppf(1.0 - FALSE_ALARMS / tests, 6)) == MOVE_GATE
    assert pytest.approx(12.59, abs=0.01) == SUSPECT  # of any table
