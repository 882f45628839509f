"""TensorBoard reads what runs write."""

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from eagle_rl.runners.event_file import EventFile


def test_tensorboard_shows_the_scalars_and_forgets_what_a_resumed_run_repeats(tmp_path):
    first = EventFile(tmp_path)
    for iteration in (1, 2, 3):
        first.write(iteration, {"Loss/value": 10.0 * iteration, "Train/mean_reward/h1": -1.0})
    resumed = EventFile(tmp_path)  # the checkpoint was of iteration 2
    resumed.write(3, {"Loss/value": 33.0})
    board = EventAccumulator(str(tmp_path)).Reload()
    assert sorted(board.Tags()["scalars"]) == ["Loss/value", "Train/mean_reward/h1"]
    assert [(e.step, e.value) for e in board.Scalars("Loss/value")] == [(1, 10.0), (2, 20.0), (3, 33.0)]


def test_a_file_that_has_vanished_is_an_error_not_silence(tmp_path):
    events = EventFile(tmp_path)
    events.write(1, {"a": 1.0})
    next(tmp_path.iterdir()).unlink()
    with pytest.raises(FileNotFoundError, match="has vanished"):
        events.write(2, {"a": 2.0})
    events.write(3, {"a": 3.0})
    assert [e.step for e in EventAccumulator(str(tmp_path)).Reload().Scalars("a")] == [3]
