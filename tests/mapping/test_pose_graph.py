"""The pose graph: closed forms, marginals by the dense inverse and by draws, wrong loops, and gtsam on the same graph."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.mapping import pose_graph
from mitsonar.mapping.odometry import graph_path
from mitsonar.mapping.pose_graph import GraphSolution, PoseEdges, PoseGraph, relative_motions, solved
from mitsonar.mapping.sensors import SensorNoise, simulated_sensors
from mitsonar.mapping.series import ErrorCorrelation, MotionSeries, path_of, pose_covariances
from mitsonar.motion.composition import motions
from mitsonar.motion.pose import Pose
from mitsonar.motion.sensors import Headings

Array = NDArray[np.float64]

STD = np.array([2e-3, 1e-3, 1e-3])
REACH_M = 3.5


def square(side: int = 10, step: float = 0.2) -> Array:
    """Motions around a square, back to where they began ``(4 * side + 4, 3)``; corners are turned on the spot."""
    leg = [[0.0, step, 0.0]] * side + [[0.0, 0.0, np.pi / 2]]
    return np.array(leg * 4)


def composed(moved: Array) -> Array:
    """The poses x, y, heading from the origin along motions."""
    poses: Array = path_of(moved, Pose(0, 0, 0), np.arange(len(moved) + 1.0)).poses[:, [0, 1, 5]]
    return poses


def graph_of(moved: Array, std: Array = STD) -> PoseGraph:
    return PoseGraph(composed(moved), PoseEdges.chain(moved, np.tile(np.diag(std**2), (len(moved), 1, 1))))


def edge(first: int, second: int, motion: Array, std: Array = STD) -> PoseEdges:
    return PoseEdges(np.array([first]), np.array([second]), np.array([motion]), np.diag(std**2)[None])


def joined(*edges: PoseEdges) -> PoseEdges:
    return PoseEdges(*(np.concatenate(parts) for parts in zip(*edges, strict=True)))


# ---------------------------------------------------------------- closed forms


def test_motions_alone_give_their_composition_and_its_covariance() -> None:
    """Two routes to one number: the graph's marginals and the covariances that are carried along a path."""
    moved = square() + STD * np.random.default_rng(0).normal(size=(44, 3))
    graph = graph_of(moved)
    result = solved(replace(graph, start=graph.start + [0, 0, 0.01] * (np.arange(45) > 0)[:, None]))
    np.testing.assert_allclose(result.poses, graph.start, atol=1e-9)
    local, following = result.covariances()
    series = MotionSeries(moved, np.arange(45.0), graph.chain.covariances)
    np.testing.assert_allclose(local, pose_covariances(series, Pose(0, 0, 0)), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(result.motion_covariances(local, following), graph.chain.covariances, rtol=1e-6, atol=1e-12)


def test_errors_that_are_alike_give_the_covariances_of_the_path_that_the_graph_has() -> None:
    """Two routes to one number, with errors that wander and slopes; a path whose errors are alike drifts by far more."""
    moved = square()
    correlated = ErrorCorrelation().along(moved, 3.0)
    local, _ = solved(replace(graph_of(moved), correlated=correlated)).covariances()
    series = MotionSeries(moved, np.arange(45.0), graph_of(moved).chain.covariances)
    message = pose_covariances(series, Pose(0, 0, 0), correlated=correlated)
    np.testing.assert_allclose(message, local, rtol=1e-5, atol=1e-12)
    independent = pose_covariances(series, Pose(0, 0, 0))
    assert np.trace(message[-1]) > 4 * np.trace(independent[-1])
    alone = pose_covariances(series, Pose(0, 0, 0), correlated=correlated, alone=np.ones(44, dtype=bool))
    np.testing.assert_allclose(alone, independent, rtol=1e-9, atol=1e-15)


def test_one_biased_edge_of_a_closed_square_is_shared_out_by_variance() -> None:
    """Along a line, a loop and n motions share an error by their variances; an exact loop closes the square."""
    moved = np.tile([0.0, 0.2, 0.0], (9, 1))
    biased = moved.copy()
    biased[4, 1] += 0.02
    graph = replace(graph_of(biased), loops=edge(0, 9, np.array([0, 1.8, 0.0])))
    result = solved(replace(graph, loops=graph.loops._replace(covariances=np.diag((10 * STD) ** 2)[None])))
    # the loop has 100 times the variance of each of 9 motions: it takes 100/109 of the error
    assert result.poses[9, 1] == pytest.approx(1.8 + 0.02 * 100 / 109, abs=1e-6)
    one = graph_of(square())
    turned = square()
    turned[10, 2] += 0.01  # the first corner
    closing = replace(one, chain=one.chain._replace(motions=turned), start=composed(turned))
    closed = solved(replace(closing, loops=edge(0, 44, np.zeros(3), 1e-6 * STD)))
    assert np.hypot(*closing.start[-1, :2]) > 0.01
    assert np.hypot(*closed.poses[-1, :2]) < 1e-6
    assert closed.poses[-1, 2] == pytest.approx(2 * np.pi, abs=1e-6)


def test_headings_join_with_motions_by_variance() -> None:
    """One heading after n motions of yaw variance s^2: the mean by weight, and its variance."""
    graph = replace(
        graph_of(np.tile([0.0, 0.1, 0.0], (4, 1))), headings=Headings(np.array([4]), np.array([0.03]), np.array([2e-3]))
    )
    result = solved(graph)
    assert result.poses[4, 2] == pytest.approx(0.03 / 2)
    local, _ = result.covariances()
    assert local[4, 2, 2] == pytest.approx(2e-6)
    unknown = np.diag([0, 0, 1.0])
    loose = solved(replace(graph, at_start=unknown))
    assert loose.poses[0, 2] == pytest.approx(0.03, abs=1e-6)
    assert loose.covariances()[0][0, 2, 2] == pytest.approx(8e-6, rel=1e-4)


def test_a_bias_of_a_sensor_is_found_by_a_heading_and_counts_in_the_covariance() -> None:
    """Four motions at rest that each show a turn of b: the heading at the end says what of it is bias."""
    still, loose = np.zeros((4, 3)), np.array([1e-3, 1e-3, 1.0])
    turning = still + np.array([0, 0, 0.01])
    graph = replace(graph_of(still, loose), others=PoseEdges.chain(turning, np.tile(np.diag(loose**2 * 1e-6), (4, 1, 1))))
    graph = replace(graph, bias=np.tile([0, 0, 0.02], (4, 1)))
    local, _ = solved(graph).covariances()
    # four independent errors of 1e-3, and four times a common one of 0.02
    assert local[4, 2, 2] == pytest.approx(4e-6 + (4 * 0.02) ** 2, rel=5e-3)
    result = solved(replace(graph, headings=Headings(np.array([4]), np.zeros(1), np.array([1e-4]))))
    np.testing.assert_allclose(result.poses[:, 2], 0, atol=1e-4)
    with pytest.raises(MitsonarError, match="for each of 4 motions"):
        replace(graph, bias=np.zeros((3, 3)))


def test_a_wrong_loop_is_left_out_and_right_ones_are_kept() -> None:
    rng = np.random.default_rng(1)
    true = composed(square())
    moved = square() + STD * rng.normal(size=(44, 3))
    pairs = [(0, 44), (1, 43), (3, 44), (2, 43)]
    right = [edge(i, j, relative_motions(true, [i], [j])[0] + STD * rng.normal(size=3)) for i, j in pairs]
    wrong = [edge(5, 26, np.zeros(3)), edge(0, 20, np.array([0.5, 0, 0]))]
    result = solved(replace(graph_of(moved), loops=joined(*right, *wrong)))
    assert result.accepted.tolist() == [True] * 4 + [False] * 2
    assert (result.squared[4:] > 100).all()
    only = solved(replace(graph_of(moved), loops=joined(*right)))
    np.testing.assert_allclose(result.poses, only.poses, atol=1e-9)


# ---------------------------------------------------------------- marginals


def tangled(rng: np.random.Generator, share: float = 0.8, slope: float = 0.01) -> tuple[PoseGraph, Array]:
    """A square with correlated errors, loops, a second sensor and headings, drawn from its own model; and the true poses."""
    moved = square()
    true = composed(moved)
    model = ErrorCorrelation(share, length=0.2, slope=slope)
    correlated = model.along(moved, REACH_M)
    wander = rng.normal(size=(44, 3))
    for k in range(1, 44):
        wander[k] = correlated.onward[k - 1] * wander[k - 1] + np.sqrt(1 - correlated.onward[k - 1] ** 2) * wander[k]
    error = np.sqrt(share) * wander + np.sqrt(1 - share) * rng.normal(size=(44, 3))
    slopes = correlated.slope_std * rng.normal(size=(3, 3))
    measured = moved + STD * error + moved @ slopes.T
    chain = PoseEdges.chain(measured, np.tile(np.diag(STD**2), (44, 1, 1)))
    gyro_std = np.array([0.02, 0.02, 2e-3])
    others = PoseEdges.chain(moved + gyro_std * rng.normal(size=(44, 3)), np.tile(np.diag(gyro_std**2), (44, 1, 1)))
    pairs = [(0, 44), (1, 43), (2, 43)]
    loops = joined(*(edge(i, j, relative_motions(true, [i], [j])[0] + STD * rng.normal(size=3)) for i, j in pairs))
    headings = Headings(np.array([20, 30]), true[[20, 30], 2] + 5e-3 * rng.normal(size=2), np.full(2, 5e-3))
    return PoseGraph(composed(measured), chain, others, loops=loops, headings=headings, correlated=correlated), true


def test_marginals_are_the_blocks_of_the_dense_inverse() -> None:
    graph, _ = tangled(np.random.default_rng(2))
    result = solved(graph)
    size = result.normal.shape[0]
    dense = result.factor.solve(np.eye(size))
    normal = np.linalg.inv(dense)
    np.testing.assert_allclose(normal @ dense, np.eye(size), atol=1e-5)
    local, following = result.covariances()
    assert not local[0].any()
    for pose in (1, 17, 44):
        place = result.states[3 * pose : 3 * pose + 3]
        np.testing.assert_allclose(local[pose], dense[np.ix_(place, place)], rtol=1e-6, atol=1e-15)
    there = result.states[3 * 17 : 3 * 19]
    np.testing.assert_allclose(following[17], dense[np.ix_(there[:3], there[3:])], rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(result.columns([18])[17, :, 0], following[17], rtol=1e-9)


@pytest.mark.parametrize("looped", [False, True])
@pytest.mark.parametrize("stretch", [1, 4, 40])
def test_marginals_of_a_long_path_are_those_of_columns(monkeypatch: pytest.MonkeyPatch, stretch: int, looped: bool) -> None:
    """A chain with correlated errors and a biased gyroscope: nodes and stretches between them are exact."""
    moved = np.tile([0.0, 0.02, 0.03], (120, 1))
    graph = replace(graph_of(moved), correlated=ErrorCorrelation().along(moved, REACH_M))
    gyro = PoseEdges.chain(moved, np.tile(np.diag([10.0, 10.0, 1e-4]) ** 2, (120, 1, 1)))
    graph = replace(graph, others=gyro, bias=np.tile([0, 0, 1e-4], (120, 1)), at_start=np.diag([0, 0, 1e-2]))
    if looped:
        pairs = [(3, 90), (5, 91), (5, 119)]
        loops = joined(*(edge(i, j, relative_motions(graph.start, [i], [j])[0]) for i, j in pairs))
        graph = replace(graph, loops=loops)
    short = solved(graph)
    local, following = short.covariances()
    monkeypatch.setattr(pose_graph, "LONG", 100)
    monkeypatch.setattr(pose_graph, "STRETCH", stretch)
    long = solved(graph)
    np.testing.assert_allclose(long.poses, short.poses, atol=1e-9)
    result, onward = long.covariances()
    scale = np.sqrt(np.diagonal(local, axis1=1, axis2=2))
    assert (np.abs(result - local) <= 1e-5 * scale[:, :, None] * scale[:, None]).all()
    assert (np.abs(onward - following) <= 1e-5 * scale[:-1, :, None] * scale[1:, None]).all()
    assert (np.linalg.eigvalsh(result[1:]) > 0).all()
    of_long, of_short = long.motion_covariances(result, onward), short.motion_covariances(local, following)
    np.testing.assert_allclose(of_long, of_short, rtol=1e-4, atol=1e-10)


@pytest.mark.slow
def test_errors_over_covariances_are_one_by_draws() -> None:
    """60 draws of the whole model; the mean of 60 chi-squares of three, a third, scatters by 11 %."""
    normalised = []
    for seed in range(60):
        graph, true = tangled(np.random.default_rng([3, seed]))
        result = solved(replace(graph, loops=graph.loops))
        off = result.poses - true
        local, _ = result.covariances()
        normalised.append([off[k] @ np.linalg.solve(local[k], off[k]) / 3 for k in (10, 22, 44)])
    assert np.mean(normalised, axis=0) == pytest.approx(np.ones(3), abs=0.35)


def test_correlated_errors_make_a_long_path_s_covariance_larger_than_independent_ones() -> None:
    moved = np.tile([0.0, 0.01, 0.0], (200, 1))
    graph = graph_of(moved)
    alone = solved(graph).covariances()[0][-1]
    model = ErrorCorrelation(share=0.9, length=0.2, slope=1e-6)
    similar = solved(replace(graph, correlated=model.along(moved, REACH_M))).covariances()[0][-1]
    # a chain of correlation r sums to (1 + r)/(1 - r) times the variance of independent ones, up to its ends
    r = np.exp(-0.01 / 0.7)
    n = 200
    expected = 0.1 + 0.9 * ((1 + r) / (1 - r) - 2 * r * (1 - r**n) / (n * (1 - r) ** 2))
    assert similar[2, 2] / alone[2, 2] == pytest.approx(expected, rel=1e-6)
    assert similar[1, 1] / alone[1, 1] == pytest.approx(expected, rel=1e-3)


# ---------------------------------------------------------------- faults and gtsam


def test_what_is_no_graph_is_refused() -> None:
    graph = graph_of(square())
    with pytest.raises(MitsonarError, match="leads to pose 99, and there are 45"):
        replace(graph, loops=edge(0, 99, np.zeros(3)))
    with pytest.raises(MitsonarError, match="two poses"):
        replace(graph, start=np.zeros((1, 3)))
    with pytest.raises(MitsonarError, match="positive"):
        solved(replace(graph, loops=edge(0, 9, np.zeros(3), np.zeros(3))))
    with pytest.raises(MitsonarError, match="not connected by any measurement"):
        solved(replace(graph, chain=graph.chain.select(np.arange(44) != 7)))
    for share, length, slope in ((1.0, 1, 1), (0.5, 0, 1), (0.5, 1, 0), (np.nan, 1, 1)):
        with pytest.raises(MitsonarError, match="share must be"):
            ErrorCorrelation(share, length, slope)


def by_gtsam(graph: PoseGraph) -> tuple[Array, Array]:
    """Poses and marginals of the same graph by gtsam, whose axes are forward and starboard of the first pose of an edge."""
    gtsam = pytest.importorskip("gtsam")
    swap = np.array([1, 0, 2])
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, (x, y, heading) in enumerate(graph.start):
        values.insert(k, gtsam.Pose2(y, x, heading))
    known = gtsam.noiseModel.Diagonal.Sigmas(np.full(3, 1e-9))
    factors.add(gtsam.PriorFactorPose2(0, values.atPose2(0), known))
    for edges in (graph.chain, graph.others, graph.loops):
        for i, j, (sideways, forward, yaw), covariance in zip(*edges, strict=True):
            sin, cos = np.sin(yaw), np.cos(yaw)
            turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])  # gtsam's errors are in axes of the first pose
            noise = gtsam.noiseModel.Gaussian.Covariance(turn @ covariance[np.ix_(swap, swap)] @ turn.T)
            # eq. 3.4 is in axes of the second heading: the way back from there
            factors.add(gtsam.BetweenFactorPose2(int(j), int(i), gtsam.Pose2(-forward, -sideways, -yaw), noise))
    result = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    marginals = gtsam.Marginals(factors, result)
    poses, covariances = [], []
    for k in range(len(graph.start)):
        pose = result.atPose2(k)
        sin, cos = np.sin(pose.theta()), np.cos(pose.theta())
        world = np.array([[sin, cos, 0], [cos, -sin, 0], [0, 0, 1]])  # forward, starboard to x, y
        poses.append([pose.y(), pose.x(), pose.theta()])
        covariances.append(world @ marginals.marginalCovariance(k) @ world.T)
    return np.array(poses), np.array(covariances)


def test_gtsam_finds_the_same_poses_and_marginals() -> None:
    graph, _ = tangled(np.random.default_rng(4), share=0.0, slope=1e-9)
    plain = replace(graph, correlated=None, headings=Headings.none())
    result = solved(plain)
    assert result.accepted.all()
    local, _ = result.covariances()
    poses, covariances = by_gtsam(plain)
    off = result.poses - poses
    off[:, 2] -= 2 * np.pi * np.rint(off[:, 2] / (2 * np.pi))
    std = np.sqrt(np.diagonal(local, axis1=1, axis2=2))
    assert (np.abs(off) <= 0.02 * std + 1e-9).all()
    np.testing.assert_allclose(covariances[1:], local[1:], rtol=0.02, atol=1e-9)


def test_motions_of_the_graph_are_those_of_paths() -> None:
    poses = composed(square() + 0.01)
    six = np.zeros((45, 6))
    six[:, [0, 1, 5]] = poses
    np.testing.assert_allclose(relative_motions(poses, np.arange(44), np.arange(1, 45)), motions(six), atol=1e-12)


def test_a_solution_answers_for_known_poses() -> None:
    result: GraphSolution = solved(graph_of(square()))
    assert not result.columns([0]).any()


def test_errors_of_the_map_say_nothing_of_those_of_two_frames() -> None:
    """A gyroscope that mends the yaw of the map's motions must not displace those of two frames, and the other way round."""
    count, valley = 200, 3.5
    time = np.arange(count + 1) / 20
    by_map = (np.arange(count) // 25) % 2 == 0
    motions = np.tile([0.02, 0.0, 0.0], (count, 1))
    bias = np.where(by_map, 2e-5, -1e-4)  # yaw; two frames confuse it with sideways motion
    motions[:, 2] += bias
    motions[~by_map, 0] -= valley * bias[~by_map]
    pair = np.array([[1e-8 + (valley * 1e-4) ** 2, 0, -valley * 1e-8], [0, 1e-8, 0], [-valley * 1e-8, 0, 1e-8]])
    covariances = np.where(by_map[:, None, None], np.diag([1e-8, 1e-8, 1e-10]), pair)
    measured = MotionSeries(motions, time, covariances)
    true = path_of(np.tile([0.02, 0.0, 0.0], (count, 1)), Pose(0, 0, 2.5, 0.6, 0, 0), time)
    gyroscope = simulated_sensors(true, SensorNoise(gyro_deg_rth=0.01), seed=0)
    graph = partial(graph_path, start_known=True, sensors=gyroscope, search=None, source=None)
    start = Pose(*true.poses[0])
    apart = graph(measured, start, by_map=by_map)
    similar = graph(measured, start)
    off, before = (abs(one.path.poses[-1, 0] - true.poses[-1, 0]) for one in (apart, similar))
    assert off < before / 2


# ---------------------------------------------------------------- correlated errors by least squares


def by_least_squares(model: ErrorCorrelation, covariance: Array, moved: Array, yaw_errors: Array, gyro_std: float) -> Array:
    """What yaw errors, known but for a gyroscope's noise, tell of the errors of motions along a straight line ``(n, 3)``."""
    count, slope = len(moved), model.along(moved, REACH_M).slope_std
    way = np.cumsum(np.hypot(moved[:, 0], moved[:, 1]))
    similar = model.share * np.exp(-np.abs(way[:, None] - way) / (model.length * REACH_M)) + (1 - model.share) * np.eye(
        count
    )
    joint = np.einsum("kl,ab->kalb", similar, covariance)
    joint += np.einsum("kl,ab->kalb", np.ones((count, count)), np.diag((slope * moved[0] * slope * moved[0]).sum(axis=1)))
    of_yaw = joint[:, 2, :, 2] + gyro_std**2 * np.eye(count)
    return np.asarray(np.einsum("kal,l->ka", joint[:, :, :, 2], np.linalg.solve(of_yaw, yaw_errors)))


@pytest.mark.parametrize("direction", [(0.012, 0.0), (0.0, 0.012)], ids=["sideways", "forward"])
def test_a_gyroscope_mends_what_errors_share_with_the_yaw_as_least_squares_do(direction: tuple[float, float]) -> None:
    """Motions that turn about the ground ahead, with errors of single ones a tenth of the motion, as those of a map."""
    count, gyro_std, model, rng = 400, 6e-5, ErrorCorrelation(), np.random.default_rng(5)
    moved = np.tile([*direction, 0.0], (count, 1))
    covariance = np.array([[1.5e-6, 0, -4e-7], [0, 1e-7, 0], [-4e-7, 0, 1.3e-7]])
    single = np.diff(1e-3 * rng.normal(size=count + 1))  # poses are registered one by one: these errors do not add up
    errors = np.outer(single + 7e-5, [1.0, 0.0, -1 / 3.4])
    gyro = PoseEdges.chain(np.zeros((count, 3)), np.tile(np.diag([10.0, 10.0, gyro_std]) ** 2, (count, 1, 1)))
    gyro.motions[:, 2] = gyro_std * rng.normal(size=count)
    measured = moved + errors
    chain = PoseEdges.chain(measured, np.tile(covariance, (count, 1, 1)))
    graph = PoseGraph(composed(measured), chain, gyro, correlated=model.along(measured, REACH_M))
    expected = composed(measured - by_least_squares(model, covariance, moved, measured[:, 2] - gyro.motions[:, 2], gyro_std))
    result = solved(graph)
    np.testing.assert_allclose(result.poses[-1, :2], expected[-1, :2], atol=1e-3)
    assert np.hypot(*(result.poses - composed(moved))[-1, :2]) < 5e-3


def test_what_slopes_are_over_adds_up_to_the_path() -> None:
    """A start from rest, a corner on the spot and errors of single motions: the sums and the corner stay, the errors go."""
    rng = np.random.default_rng(6)
    steady = np.concatenate([np.zeros((300, 3)), np.tile([0.0, 0.01, 0.0], (300, 1))])
    moved = np.concatenate([steady, [[0.0, 0.0, np.pi / 2]], np.tile([0.01, 0.0, 0.0], (300, 1))])
    noisy = moved + 1e-3 * rng.normal(size=moved.shape)
    sloped = ErrorCorrelation().along(noisy, REACH_M).sloped
    np.testing.assert_allclose(sloped.sum(axis=0), noisy.sum(axis=0), atol=1e-12)
    assert np.abs(sloped[440:460] - moved[440:460])[:, :2].max() < 4e-4
    assert sloped[600, 2] == pytest.approx(np.pi / 2, rel=0.15)


def test_a_motion_without_freedom_names_the_estimator_s_option() -> None:
    """As `likelihood` states it for impulse responses, where it takes the heading as constant."""
    edges = PoseEdges.chain(np.zeros((2, 3)), np.tile(np.diag([1e-6, 1e-6, 0.0]), (2, 1, 1)))
    with pytest.raises(MitsonarError, match=r"positive definite: got one that is not; .* likelihood:yaw=1"):
        _ = edges.whitening
