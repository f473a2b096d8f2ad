"""When rows of fasteners are open and closed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.files.said import listening
from hood.scene.holding import FASTEST, SPEED, Event, Fastening, fastening_of, first_step, needed_speed, steps_left
from hood.scene.scene import Scene

ROWS = {"zip": np.array([[0, 1], [2, 3]]), "buttons": np.array([[4, 5]])}


def fastening(*events: Event) -> Fastening:
    pos = torch.zeros(6, 3)
    pos[1::2, 0] = torch.tensor([0.004, 0.005, 0.006])
    made = fastening_of(ROWS, pos)
    assert made is not None
    return made.with_events(events)


def test_pairs_keep_the_distance_that_they_have_at_rest() -> None:
    made = fastening()
    assert made.names == ("buttons", "zip")
    assert made.pairs.edges.tolist() == [[4, 5], [0, 1], [2, 3]]
    torch.testing.assert_close(made.pairs.length, torch.tensor([0.006, 0.004, 0.005]))
    assert fastening_of(None, torch.zeros(6, 3)) is None
    assert fastening_of({}, torch.zeros(6, 3)) is None


def test_events_act_from_their_frame_on_in_any_order() -> None:
    made = fastening(Event(9, "zip", True), Event(3, "zip", False), Event(5, "buttons", True))
    assert [made.closed(frame) for frame in (0, 2, 3, 5, 8, 9, 50)] == [
        (False, True), (False, True), (False, False), (True, False), (True, False), (True, True), (True, True)
    ]  # fmt: skip
    assert made.at(4).active.tolist() == [False, False, False]
    assert made.at(5).active.tolist() == [True, False, False]
    assert fastening().at(7).active.all()


def test_a_row_comes_together_at_the_speed_of_what_closes_it() -> None:
    made = fastening(Event(9, "zip", True, 0.5), Event(3, "zip", False), Event(5, "zip", True, 2.0))
    assert [made.speeds(frame) for frame in (0, 4, 5, 8, 9)] == [
        (SPEED, 2.0), (SPEED, 2.0), (SPEED, 2.0), (SPEED, 2.0), (SPEED, 0.5)
    ]  # fmt: skip
    assert made.at(5).speed.tolist() == [SPEED, 2.0, 2.0]
    assert made.at(9).speed.tolist() == made.still(9).at(0).speed.tolist() == [SPEED, 0.5, 0.5]
    assert fastening().at(0).speed.tolist() == [SPEED] * 3


def apart(*gaps: float) -> torch.Tensor:
    """(6, 3) m: pairs of the rows, buttons last, so far apart beyond their distance at rest."""
    pos = torch.zeros(6, 3)
    pos[1::2, 1] = torch.tensor(gaps) + torch.tensor([0.004, 0.005, 0.006])
    return pos


def test_pairs_of_a_row_arrive_together_by_their_frame() -> None:
    """Each at a speed of its own, from where it is: a rollout may begin between, and what is held back comes faster."""
    dt, made = 1 / 30, fastening(Event(10, "zip", True, by=40), Event(10, "buttons", True, 0.5))
    assert steps_left(10, 40, 10, dt) == 27  # a tenth of a second for the last millimetre
    speed = made.at(10, apart(0.27, 0.09, 0.2), dt).speed
    torch.testing.assert_close(speed, torch.tensor([0.5, 0.3, 0.1]), rtol=1e-5, atol=0)
    assert made.at(10).speed.tolist() == [0.5, SPEED, SPEED]
    again = fastening(Event(10, "zip", True, by=40), Event(10, "buttons", True, 0.5))
    for frame, gaps in ((19, (0.18, 0.06, 0.0)), (30, (0.07, 0.07, 0.0))):
        wanted = torch.tensor(gaps[:2]) / ((37 - frame) * dt)
        torch.testing.assert_close(again.at(frame, apart(*gaps), dt).speed[1:], wanted, rtol=1e-5, atol=1e-7)
    assert (again.at(37, apart(0.4, 0.001, 0.0), dt).speed[1:] - torch.tensor([FASTEST, 0.03])).abs().max() < 1e-5
    assert made.at(9, apart(0.27, 0.09, 0.2), dt) is made.at(3)  # not yet
    late = replace(made, _known={}).with_events([Event(5, "zip", True, by=20), Event(15, "zip", False), Event(40, "zip", True)])
    assert late.at(50, apart(0.3, 0.3, 0.3), dt).speed.tolist() == [SPEED] * 3


def test_the_edges_of_a_timed_row_stay_the_same_object() -> None:
    made = fastening(Event(3, "zip", True, by=9))
    assert made.at(5, apart(0.1, 0.1, 0.1), 1 / 30).edges is made.at(0).edges


def test_how_fast_a_row_closes_is_said_once_and_too_fast_is_warned_about() -> None:
    made, heard = fastening(Event(10, "zip", True, by=40)), list[str]()
    with listening(lambda sentence, *_: heard.append(sentence)):
        for _ in range(2):
            made.at(10, apart(0.27, 0.09, 0.2), 1 / 30)
    assert heard == ["zip: closes from 0.33 s (frame 10) on, by 1.33 s (frame 40), at 0.10 to 0.30 m/s"]
    hasty = fastening(Event(10, "zip", True, by=14))
    said = "up to 0.30 m apart in frame 10, which needs 2.25 m/s, 0.75 m/s more than the 1.5 m/s .* by: frame 17 .0.57 s.,"
    with pytest.warns(UserWarning, match=f"zip: closes by 0.47 s .frame 14.: {said}"):
        hasty.at(10, apart(0.3, 0.1, 0.1), 1 / 30)
    assert float(needed_speed(torch.tensor(0.3), steps_left(10, 17, 10, 1 / 30), 1 / 30)) == pytest.approx(FASTEST)


def test_the_edges_are_the_same_object_in_all_steps() -> None:
    """Solvers and captured steps know a plan by it."""
    made = fastening(Event(3, "zip", False))
    assert made.at(0).edges is made.at(3).edges
    assert made.at(3) is made.at(8)


def test_what_is_still_has_no_events() -> None:
    made = fastening(Event(3, "zip", False), Event(6, "buttons", True)).still(4)
    assert {made.closed(frame) for frame in (0, 3, 6, 100)} == {(False, False)}


@pytest.mark.parametrize(("seconds", "frame"), [(0.0, 0), (1.0, 30), (1.0 / 30, 1), (0.034, 2), (2.0, 60)])
def test_an_event_acts_in_the_first_step_that_begins_at_its_time_or_later(seconds: float, frame: int) -> None:
    assert first_step(seconds, 1 / 30) == frame


def test_a_scene_gives_its_fastening_to_steps(tank_scene: Scene) -> None:
    rows = fastening_of({"zip": np.array([[0, 1]])}, tank_scene.cloth.rest_pos)
    assert rows is not None
    scene = replace(tank_scene, fastening=rows.with_events([Event(2, "zip", False)]))
    state = scene.start()
    assert scene.step_input(1, state).attachments.active.tolist() == [True]
    assert scene.step_input(2, state).attachments.active.tolist() == [False]
    given = replace(rows.pairs, active=torch.tensor([False]))
    assert scene.step_input(1, state, attachments=given).attachments is given
    assert tank_scene.step_input(1, state).attachments is None
    lead = scene.lead_in(3)
    assert lead is not None
    assert lead.step_input(0, lead.start()).attachments.active.tolist() == [False]
