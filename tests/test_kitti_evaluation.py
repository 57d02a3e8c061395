"""The metrics of tracks on sequences small enough to count by hand."""

from __future__ import annotations

import builtins
from itertools import permutations
from typing import Any

import numpy as np
import pytest

from experiments.kitti_evaluation import (
    RECALLS,
    best_threshold,
    changes,
    compare_all,
    count,
    count_all,
    evaluate,
    over_recall,
    thresholds,
    trackeval_data,
)
from experiments.kitti_matching import LEAST_OVERLAP, Compared, TrackBoxes, boxes_of, compare, covered, match
from experiments.scenarios.kitti_tracking import kitti_tracking
from experiments.scenarios.scene import Scene
from models.program import InputError
from tests.drawn_cars import car, report, scene

pytest.importorskip("trackeval", reason="trackeval comes with the extra 'tracking' only")

NUM = 6
LANES = (-4.0, 4.0)
Rows = list[tuple[int, int, np.ndarray]]


def two_cars(names: tuple[int, int] = (7, 8)) -> Rows:
    """Two cars side by side that drive away."""
    return [(t, name, car(x, 20.0 + t, -np.pi / 2)) for t in range(NUM) for name, x in zip(names, LANES, strict=True)]


def counted(truth: Scene, rows: Rows) -> Any:
    return count_all(compare_all([truth], [report(rows, NUM)]))


def test_perfect_tracks_score_one() -> None:
    scores = evaluate([scene(two_cars(), NUM)], [report(two_cars((1, 2)), NUM)])
    for name in ("mota", "motp", "recall", "precision", "hota", "deta", "assa", "idf1", "mota_gaps"):
        assert scores[name] == pytest.approx(1.0), name
    for name in ("ids", "frag", "ids_gaps", "frag_gaps"):
        assert scores[name] == 0, name


def test_nothing_reported_misses_everything_and_nothing_else() -> None:
    scores = evaluate([scene(two_cars(), NUM)], [report([], NUM)])
    assert scores["mota"] == scores["hota"] == scores["idf1"] == scores["samota"] == scores["precision"] == 0.0


def test_one_change_of_track_is_one_switch() -> None:
    rows = [(t, 1 if name == 7 and t < 3 else name, box) for t, name, box in two_cars()]
    scores = evaluate([scene(two_cars(), NUM)], [report(rows, NUM)])
    assert scores["ids"] == scores["ids_gaps"] == scores["frag"] == 1
    assert scores["mota"] == pytest.approx(1 - 1 / 12)
    assert scores["idf1"] == pytest.approx(2 * 9 / (12 + 12))  # one of the halves is nobody's


def test_a_change_of_track_in_a_gap_is_a_switch_for_trackeval_only() -> None:
    rows = [(t, 1 if name == 7 and t < 3 else name, box) for t, name, box in two_cars() if (t, name) != (3, 7)]
    scores = evaluate([scene(two_cars(), NUM)], [report(rows, NUM)])
    assert (scores["ids"], scores["ids_gaps"], scores["frag"], scores["frag_gaps"]) == (0, 1, 1, 1)
    assert scores["mota"] == pytest.approx(1 - 1 / 12)  # the miss
    assert scores["mota_gaps"] == pytest.approx(1 - 2 / 12)


@pytest.mark.parametrize(
    ("track", "left_out", "switches", "fragmentations"),
    [
        ([1, 1, 1, 1], [], 0, 0),
        ([1, 1, 2, 2], [], 1, 1),
        ([1, 2, 1, 1], [], 2, 2),
        ([1, -1, 1, 1], [], 0, 1),
        ([1, -1, 1, -1], [], 0, 0),  # lost again at once
        ([1, 1, -1, 1], [], 0, 1),  # in the last frame
        ([-1, -1, 1, 1], [], 0, 0),  # found late
        ([-1, -1, -1, 1], [], 0, 1),  # but for the last frame: the public rule to its letter
        ([1, 1, 2, 2], [1], 0, 0),  # forgotten where it does not count
        ([1, 2, 2, 2], [0], 1, 1),  # but for the first frame
        ([1, 2, 3, 4], [0, 1, 2, 3], 0, 0),
        ([1], [], 0, 0),
    ],
)
def test_switches_and_fragmentations_of_one_car(
    track: list[int], left_out: list[int], switches: int, fragmentations: int
) -> None:
    out = np.isin(np.arange(len(track)), left_out)
    assert changes(np.array(track), out) == (switches, fragmentations)


# What does not count


def test_a_box_of_25_pixels_is_ignored_and_a_higher_one_is_false() -> None:
    truth = scene(two_cars(), NUM)
    far = car(20.0, 720 * 1.5 / 25 + 0.8)  # its front is 0.8 m nearer: 25 px there
    far[4] = far[0]  # its top as high as the camera
    for nearer, false in ((-1e-6, 0), (0.1, 1)):
        rows = sorted([*two_cars(), (0, 1, far - [0, 0, 0, 0, 0, nearer, 0])], key=lambda row: row[0])
        assert counted(truth, rows).false == false


def test_a_false_box_in_a_region_without_labels_is_ignored() -> None:
    ghost = (2, 1, car(15.0, 25.0))
    rows = sorted([*two_cars(), ghost], key=lambda row: row[0])
    assert counted(scene(two_cars(), NUM), rows).false == 1
    around = [900.0, 100.0, 1241.0, 300.0]
    assert counted(scene(two_cars(), NUM, dont_care=[(2, around)]), rows).false == 0
    assert counted(scene(two_cars(), NUM, dont_care=[(3, around)]), rows).false == 1  # another frame
    corner = [900.0, 100.0, 1010.0, 300.0]
    assert counted(scene(two_cars(), NUM, dont_care=[(2, corner)]), rows).false == 1  # less than half of it


def test_a_box_beside_the_image_is_false() -> None:
    rows = sorted([*two_cars(), (2, 1, car(60.0, 20.0))], key=lambda row: row[0])
    assert counted(scene(two_cars(), NUM), rows).false == 1


@pytest.mark.parametrize("fields", [{"kind": "Van"}, {"truncation": 1}, {"occlusion": 3}])
def test_what_is_labelled_but_does_not_count_is_neither_missed_nor_false(fields: dict[str, Any]) -> None:
    truth = scene(two_cars(), NUM, **fields)
    for rows in (two_cars(), []):
        found = counted(truth, rows)
        assert (found.labels, found.missed, found.false) == (0, 0, 0)
    with pytest.raises(InputError, match="no labelled car counts"):
        evaluate([truth], [report(two_cars(), NUM)])


@pytest.mark.parametrize("fields", [{"kind": "Pedestrian"}])
def test_a_box_on_another_kind_of_object_is_false(fields: dict[str, Any]) -> None:
    assert counted(scene(two_cars(), NUM, **fields), two_cars()).false == 12


def test_what_is_barely_visible_still_counts() -> None:
    assert counted(scene(two_cars(), NUM, occlusion=2), []).missed == 12


def test_covered_is_the_share_of_the_box_not_of_the_region() -> None:
    box, regions = np.array([[0.0, 0.0, 10.0, 10.0]]), np.array([[5.0, 0.0, 100.0, 5.0], [20.0, 0.0, 30.0, 5.0]])
    np.testing.assert_allclose(covered(box, regions), [[0.25, 0.0]])
    assert covered(np.zeros((1, 4)), regions).tolist() == [[0.0, 0.0]]


# Pairs


def crowded(seed: int) -> Compared:
    """Four cars on top of one another, and boxes about them."""
    rng = np.random.default_rng(seed)
    draw = lambda: car(*rng.normal([0.0, 20.0], [1.0, 0.7]), 0.0)  # noqa: E731
    truth = scene([(0, i, draw()) for i in range(4)], 1)
    return compare(truth.data, truth.truth, report([(0, i, draw()) for i in range(5)], 1))


def test_pairs_are_those_of_brute_force() -> None:
    for seed in range(20):
        some = crowded(seed)
        pair = match(some, np.ones(5, dtype=bool))
        iou = np.zeros((4, 5))
        iou[some.pairs[:, 0], some.pairs[:, 1]] = some.overlap
        good = iou >= LEAST_OVERLAP
        best = max(
            (good[range(4), order].sum(), (iou * good)[range(4), order].sum()) for order in permutations(range(5), 4)
        )
        assert (pair >= 0).sum() == best[0]
        assert some.overlap[pair[pair >= 0]].sum() == pytest.approx(best[1])


def test_a_box_that_goes_frees_the_label_for_another() -> None:
    truth = scene([(0, 7, car())], 1)
    some = compare(truth.data, truth.truth, report([(0, 1, car(0.2)), (0, 2, car(0.8))], 1))
    for kept, box in (([True, True], 0), ([False, True], 1)):
        assert some.pairs[match(some, np.array(kept)), 1] == [box]
    assert match(some, np.zeros(2, dtype=bool)) == [-1]


# Over recall


def test_averages_over_recall_are_worked_by_hand() -> None:
    """Of 400 cars 240 are found, each by a track of its own and with a score of its own, and 20 false boxes score less
    than 40 of these: 10 more cars at each of 24 recalls, and from recall .525 on the false ones with them."""
    cars = [(t, t, car()) for t in range(400)]
    rows = [(t, t, car()) for t in range(240)] + [(t, t, car(8.0)) for t in range(240, 260)]
    tracks = report(rows, 400)._replace(score=np.concatenate([np.arange(240.0, 0.0, -1.0), np.full(20, 40.5)]))
    compared = compare_all([scene(cars, 400)], [tracks])
    recall = np.arange(1, 25) / RECALLS
    np.testing.assert_allclose(thresholds(compared), np.stack([241 - 400 * recall, recall], 1))
    false = np.where(recall > 0.51, 20, 0)
    averages = over_recall(compared)
    assert averages["samota"] == pytest.approx((1 - false / (400 * recall)).sum() / RECALLS)
    assert averages["amota"] == pytest.approx((recall - false / 400).sum() / RECALLS)
    assert averages["amotp"] == pytest.approx(24 / RECALLS)


def test_the_best_threshold_drops_false_tracks_by_their_mean_score() -> None:
    ghost = [(t, 3, car(0.0, 12.0)) for t in range(NUM)]
    rows = sorted([*two_cars(), *ghost], key=lambda row: row[0])
    tracks = report(rows, NUM)
    score = np.where(tracks.track == 3, np.where(np.arange(len(rows)) < 3, 0.9, 0.1), 0.7)  # the ghost begins well
    scenes, reported = [scene(two_cars(), NUM)], [tracks._replace(score=score)]
    threshold = best_threshold(compare_all(scenes, reported))
    assert threshold == pytest.approx(0.7)
    assert evaluate(scenes, reported, threshold=threshold)["mota"] == 1.0
    assert evaluate(scenes, reported)["mota"] == pytest.approx(1 - 6 / 12)


def test_sequences_are_pooled_by_counts() -> None:
    both = [scene(two_cars(), NUM), scene([(0, 7, car())], NUM)]
    scores = evaluate(both, [report(two_cars(), NUM), report([], NUM)])
    assert scores["mota"] == pytest.approx(1 - 1 / 13)
    with pytest.raises(InputError, match="1 trackers' results for 2 sequences"):
        evaluate(both, [report([], NUM)])


# From a tracker's output


def test_boxes_in_the_world_become_what_is_evaluated() -> None:
    truth = scene(two_cars(), NUM)
    labels = truth.truth
    size, place = labels.size, labels.position
    tracks = boxes_of(truth.data, labels.offset, labels.track, place, labels.heading, size, np.ones(12))
    np.testing.assert_allclose(tracks.box, labels.camera, atol=1e-12)
    assert evaluate([truth], [tracks])["hota"] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"heading": np.full(12, np.nan)}, "heading of sequence made up holds a value that is not finite"),
        ({"size": np.zeros((12, 3))}, "size of sequence made up is 0 m"),
        ({"size": np.ones((12, 2))}, r"size has shape \(12, 2\); 12 boxes need \(12, 3\)"),
        ({"track": np.full(12, 5)}, "track 5 is twice in frame 0"),
        ({"offset": np.array([0, 12])}, "give 7 numbers that grow from 0 to the 12 boxes"),
    ],
)
def test_tracks_that_cannot_be_evaluated_are_named(change: dict[str, Any], sentence: str) -> None:
    truth = scene(two_cars(), NUM)
    t = truth.truth
    given = {"offset": t.offset, "track": t.track, "position": t.position, "heading": t.heading, "size": t.size}
    with pytest.raises(InputError, match=sentence):
        boxes_of(truth.data, **(given | {"score": np.ones(12)} | change))


def test_a_missing_trackeval_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name.startswith("trackeval"):
            raise ImportError("No module named 'trackeval'")
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=r"need trackeval.*pip install 'waybayes\[tracking\]'"):
        evaluate([scene(two_cars(), NUM)], [report(two_cars(), NUM)])


def test_trackeval_reads_what_counts_only() -> None:
    truth = scene([(0, 4, car(-4.0)), (0, 5, car(4.0))], 1)
    kinds = truth.truth._replace(kind=np.array(["Van", "Car"]))
    tracks = report([(0, 1, car(-4.0)), (0, 2, car(4.0, 20.3)), (0, 3, car(0.0, 80.0))], 1)
    data = trackeval_data(compare(truth.data, kinds, tracks), np.ones(3, dtype=bool))
    assert (data["num_gt_dets"], data["num_tracker_dets"]) == (1, 1)
    assert data["similarity_scores"][0].shape == (1, 1) and 0.5 < data["similarity_scores"][0][0, 0] < 1


def test_real_labels_reported_as_tracks_are_perfect() -> None:
    try:
        truth = kitti_tracking("0014")
    except InputError as absent:
        pytest.skip(str(absent))
    labels = truth.truth
    cars = np.isin(labels.kind, ["Car", "Van"])
    offset = np.concatenate([[0], np.cumsum(cars)])[labels.offset]
    tracks = TrackBoxes(offset, labels.track[cars], labels.camera[cars], np.ones(cars.sum()))
    scores = evaluate([truth], [tracks])
    assert scores["mota"] == 1.0 and scores["hota"] == pytest.approx(1.0) and scores["ids_gaps"] == 0
    assert count(compare(truth.data, labels, tracks), np.ones(cars.sum(), dtype=bool)).false == 0
