"""Training runs stop politely and survive broken logs, full disks and unsound numbers."""

import math
import shutil
import signal

import pytest
import torch

from eagle_rl.config.schema import RunCfg
from eagle_rl.errors import CheckpointError, EagleWarning, HealthError, Interrupted
from eagle_rl.runners import checkpoint as ckpt
from eagle_rl.runners import files
from eagle_rl.runners.health import require_sound
from eagle_rl.runners.throttle import ThrottledWarning
from tests.learner.helpers import make_runner
from tests.learner.test_runner import assert_same
from tests.toy import ToyEnv

BOTH = (signal.SIGINT, signal.SIGTERM)
"""What a helper of ``--jobs`` gets: a Ctrl-C as the terminal's other processes do, then what its main process sends."""
TWICE = (signal.SIGTERM, signal.SIGTERM)
"""The same where a supervisor stops all processes of a run."""


@pytest.mark.parametrize("numbers", [(signal.SIGINT,), (signal.SIGTERM,), BOTH, TWICE])
def test_an_interrupted_run_finishes_its_iteration_saves_and_goes_on_unchanged(tmp_path, numbers):
    whole = make_runner()
    whole.learn(4)
    runner = make_runner(tmp_path)
    with pytest.raises(Interrupted, match="after iteration 2") as caught:
        runner.learn(4, on_iteration=lambda i: [signal.raise_signal(n) for n in numbers] if i == 2 else None)
    assert caught.value.exit_code == 130
    resumed = make_runner(tmp_path)
    resumed.load(ckpt.latest_checkpoint(tmp_path / "checkpoints"))
    assert resumed.current_learning_iteration == 2
    resumed.learn(2)
    assert_same(whole, resumed)


@pytest.mark.parametrize("first", [signal.SIGINT, signal.SIGTERM])
def test_a_second_ctrl_c_leaves_at_once_with_the_last_checkpoint_intact(tmp_path, first):
    def twice(iteration: int) -> None:
        if iteration == 3:
            signal.raise_signal(first)
            signal.raise_signal(signal.SIGINT)

    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt) as caught:
        make_runner(tmp_path, run=RunCfg(save_interval=2)).learn(5, on_iteration=twice)
    assert caught.type is KeyboardInterrupt
    assert ckpt.latest_checkpoint(tmp_path / "checkpoints").name == "model_2.pt"
    assert signal.getsignal(signal.SIGINT) is handler


def test_a_vanished_log_folder_is_reported_once_and_training_goes_on(tmp_path):
    folder = tmp_path / "run"
    runner = make_runner(folder)
    with pytest.warns(EagleWarning, match="training goes on") as caught:
        path = runner.learn(4, on_iteration=lambda i: shutil.rmtree(folder) if i == 1 else None)
    assert len(caught) == 1
    assert runner.current_learning_iteration == 4
    ckpt.verify_checkpoint(path)


def test_a_full_disk_keeps_the_last_good_checkpoint_and_training_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "PATIENCE_S", 0.0)

    def fill_disk(iteration: int) -> None:
        if iteration == 2:
            monkeypatch.setattr(ckpt, "write_atomically", full)

    def full(path, data):
        raise OSError(28, "No space left on device")

    runner = make_runner(tmp_path, run=RunCfg(save_interval=1))
    with (
        pytest.warns(EagleWarning, match=r"No space left.*Training goes on"),
        pytest.raises(CheckpointError, match="could not be written"),
    ):
        runner.learn(4, on_iteration=fill_disk)
    assert runner.current_learning_iteration == 4
    assert ckpt.latest_checkpoint(tmp_path / "checkpoints").name == "model_2.pt"


def test_the_end_of_a_stage_waits_for_a_disk_to_become_free(tmp_path, monkeypatch):
    save, tries = ckpt.save_checkpoint, []

    def full_twice(*args, **kwargs):
        tries.append(1)
        if len(tries) <= 2:
            raise OSError(28, "No space left on device", "model_1.pt")
        return save(*args, **kwargs)

    monkeypatch.setattr(ckpt, "save_checkpoint", full_twice)
    monkeypatch.setattr(files, "RETRY_S", 0.0)
    with pytest.warns(EagleWarning, match=r"No space left.*waits, for 10 min at most") as caught:
        path = make_runner(tmp_path).learn(1)
    assert len(caught) == 1, "once a minute"
    assert ckpt.verify_checkpoint(path)["stage_end"]


def test_a_health_rule_is_named_even_if_the_disk_is_full(tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise OSError(28, "No space left on device", "model_1.pt")

    class Sick(ToyEnv):
        def step(self, actions):
            obs, rewards, dones, extras = super().step(actions)
            return obs, rewards * math.inf, dones, extras

    monkeypatch.setattr(ckpt, "save_checkpoint", full)
    with pytest.warns(EagleWarning, match="No space left"), pytest.raises(HealthError, match="rewards is not finite"):
        make_runner(tmp_path, Sick()).learn(1)


def test_warnings_are_repeated_once_a_minute_at_most():
    times = iter(range(0, 150, 10))
    warn = ThrottledWarning(lambda: next(times))
    with pytest.warns(EagleWarning, match="full") as caught:
        [warn("full") for _ in range(15)]
    assert len(caught) == 3


@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf, 1e12, -1e12])
def test_what_is_not_finite_or_absurd_is_named_with_its_robot_and_environments(poison):
    robot = torch.tensor([0, 0, 1, 1])
    tensors = {"history": torch.zeros(4, 7), "rewards": torch.zeros(4)}
    require_sound(tensors, robot, ["h1", "g1"])
    tensors["history"][2:, 5] = poison
    fault, value = ("absurd", tensors["history"][2, 5].item()) if math.isfinite(poison) else ("not finite", poison)
    expected = rf"history is {fault}: {value} in column 5; robots g1; environments \[2, 3\]"
    with pytest.raises(HealthError, match=expected):
        require_sound(tensors, robot, ["h1", "g1"])


@pytest.mark.parametrize("where", ["rewards", "critic", "history", "estimate"])
@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf, 1e12])
def test_an_unsound_environment_stops_the_run_in_the_same_step_with_a_checkpoint(tmp_path, where, poison):
    class Sick(ToyEnv):
        steps = 0

        def step(self, actions):
            obs, rewards, dones, extras = super().step(actions)
            self.steps += 1
            if self.steps == 12:
                (rewards if where == "rewards" else obs[where])[4] = poison
            return obs, rewards, dones, extras

    runner = make_runner(tmp_path, Sick())
    fault = "absurd" if poison == 1e12 else "not finite"
    with pytest.raises(HealthError, match=rf"{where} is {fault}: .* in column 0; robots two; environments \[4\]"):
        runner.learn(3)
    assert runner.env.steps == 12
    assert ckpt.latest_checkpoint(tmp_path / "checkpoints").name == "model_1.pt"


def test_parameters_that_are_not_finite_are_never_saved(tmp_path):
    runner = make_runner(tmp_path)
    with torch.no_grad():
        runner.alg.critic.mlp[0].bias[0] = math.nan
    with pytest.raises(HealthError, match=r"mlp\.0\.bias is not finite"):
        runner.save()
    assert not (tmp_path / "checkpoints").exists()


def test_a_stage_that_was_interrupted_after_its_last_iteration_ends_without_new_data(tmp_path):
    with pytest.raises(Interrupted, match=r"saved as .*model_1\.pt"):
        make_runner(tmp_path).learn(1, on_iteration=lambda i: signal.raise_signal(signal.SIGINT))
    path = ckpt.latest_checkpoint(tmp_path / "checkpoints")
    before = path.read_bytes()
    resumed = make_runner(tmp_path)
    resumed.load(path)
    assert resumed.learn(0) == path
    assert path.read_bytes() == before
    assert ckpt.verify_checkpoint(path)["stage_end"]
