"""Training runs learn, and resume bit for bit."""

import itertools
import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from rich.console import Console

from eagle_rl.algorithms.specialists import SpecialistBank
from eagle_rl.algorithms.stopwatch import SECTIONS
from eagle_rl.errors import CheckpointError
from eagle_rl.runners import checkpoint as ckpt
from eagle_rl.runners.on_policy import EagleRunner
from eagle_rl.runners.progress import BUDGET_INTERVAL, ProgressReport
from eagle_rl.runners.provenance import Provenance
from tests.learner.helpers import make_runner, parameters
from tests.learner.test_eagle_ppo import shaken
from tests.toy import ToyEnv

ROOT = Path(__file__).parents[2]


def metrics(folder: Path) -> list[dict]:
    """Lines of a run's metrics without those that measure time."""
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in row.items() if not k.startswith("Perf/")} for row in rows]


def assert_same(one: EagleRunner, other: EagleRunner) -> None:
    """Everything that decides the future is equal, bit for bit."""
    a, b = one._state(), other._state()
    for state in (a, b):
        state["runner"].pop("wall_time")
    compare(a, b, "state")


def compare(a, b, where: str) -> None:
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            compare(a[key], b[key], f"{where}.{key}")
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            compare(x, y, f"{where}[{i}]")
    elif isinstance(a, torch.Tensor):
        assert torch.equal(a, b), where
    else:
        assert a == b, where


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_training_raises_the_reward_of_every_robot(tmp_path, precision):
    algo = {"gamma": 0.8, "num_steps_per_env": 16, "desired_kl": 0.02, "learning_rate_range": (1e-4, 1e-2)}
    make_runner(tmp_path, ToyEnv(48), precision=precision, **algo).learn(30)
    rows = metrics(tmp_path)
    first, last = rows[4], rows[-1]  # by the fifth iteration the shortened first episodes are few
    for robot, share in {"/one": 0.7, "/two": 0.7, "/three": 0.9, "": 0.7}.items():
        begin, end = (r[f"Train/mean_reward{robot}"] / r[f"Train/mean_episode_length{robot}"] for r in (first, last))
        assert end > share * begin, f"reward per step{robot}: {begin} -> {end}"  # rewards are negative
    assert last["Loss/estimation"] < 0.5 * first["Loss/estimation"]


def test_scalars_carry_the_field_s_tags(tmp_path):
    make_runner(tmp_path).learn(2)
    row = json.loads((tmp_path / "metrics.jsonl").read_text().splitlines()[-1])
    wanted = """Train/mean_reward Train/mean_episode_length Train/mean_reward/one Perf/total_fps Perf/collection_time
        Perf/learning_time Loss/value Loss/surrogate Loss/entropy Loss/estimation Loss/mirror Loss/learning_rate
        Policy/mean_std Metrics/error/one Health/skipped_updates iteration"""
    assert set(wanted.split()) <= set(row)
    assert row["iteration"] == 2
    assert row["Perf/env_steps"] == 2 * 8 * 24
    assert list(tmp_path.glob("events.out.tfevents.*"))


def test_logged_rewards_and_lengths_are_those_of_finished_episodes():
    runner = make_runner()
    episodes = runner.logger.episodes
    n = runner.env.num_envs
    for step in range(3):
        dones = torch.zeros(n, dtype=torch.bool)
        dones[0] = step == 1  # robot one: two steps of 1.0
        dones[4] = step == 2  # robot two: three steps of 1.0
        episodes.add(torch.ones(n), dones)
    tags = episodes.collect()
    assert tags["Train/mean_reward/one"] == tags["Train/mean_episode_length/one"] == 2.0
    assert tags["Train/mean_reward/two"] == 3.0
    assert tags["Train/mean_reward"] == 2.5
    assert "Train/mean_reward/three" not in tags
    episodes.add(torch.full((n,), -4.0), torch.ones(n, dtype=torch.bool))
    tags = episodes.collect()
    fresh = n // 3 - 1  # environments of robot one that had not finished before
    lengths = [2.0, 2.0] + [4.0] * fresh  # the first has begun anew after two steps
    assert tags["Train/mean_episode_length/one"] == pytest.approx(sum(lengths) / len(lengths))
    rewards = [2.0, -3.0] + [-1.0] * fresh
    assert tags["Train/mean_reward/one"] == pytest.approx(sum(rewards) / len(rewards))


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_resumed_run_equals_the_uninterrupted_one_bit_for_bit(tmp_path, precision):
    whole = make_runner(tmp_path / "whole", precision=precision)
    whole.learn(5)
    cut = make_runner(tmp_path / "cut", precision=precision)
    path = cut.learn(3)  # 24 steps: in the middle of episodes of 16
    torch.manual_seed(12345)
    resumed = make_runner(tmp_path / "cut", precision=precision)
    resumed.load(path)
    resumed.learn(2)
    assert_same(whole, resumed)
    assert metrics(tmp_path / "cut") == metrics(tmp_path / "whole")


def test_a_resumed_distillation_equals_the_uninterrupted_one(tmp_path):
    def runner(name: str) -> EagleRunner:
        r = make_runner(tmp_path / name)
        actor = make_runner(seed=5).alg.actor
        torch.manual_seed(1)
        r.alg.imitate(SpecialistBank([shaken(actor, seed) for seed in range(3)]), "kickstart")
        return r

    whole, cut = runner("whole"), runner("cut")
    whole.learn(4)
    torch.manual_seed(1)
    cut.learn(2)
    resumed = runner("cut")
    resumed.load(ckpt.latest_checkpoint(tmp_path / "cut" / "checkpoints"))
    resumed.learn(2)
    compare(parameters(whole), parameters(resumed), "parameters")
    assert resumed.alg.num_updates == 4


def test_lines_beyond_the_checkpoint_and_torn_ones_are_dropped_on_resume(tmp_path):
    path = make_runner(tmp_path).learn(2)
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"iteration": 3, "Loss/value": 1.0}\n{"iteration": 4, "Lo')
    resumed = make_runner(tmp_path)
    resumed.load(path)
    resumed.learn(1)
    assert [row["iteration"] for row in metrics(tmp_path)] == [1, 2, 3]


def test_a_changed_configuration_or_robot_is_refused_unless_drift_is_allowed(tmp_path):
    before = Provenance(config={"algo": {"gamma": 0.9}}, robots={"one": "aa", "two": "bb"})
    after = Provenance(config={"algo": {"gamma": 0.8}}, robots={"one": "aa", "two": "cc"})
    path = make_runner(tmp_path, provenance=before).learn(1)
    runner = make_runner(tmp_path, provenance=after)
    untouched = parameters(runner)
    with pytest.raises(CheckpointError, match=r"(?s)config\.algo\.gamma: 0\.9 -> 0\.8.*robot_hashes\.two: bb -> cc"):
        runner.load(path)
    compare(untouched, parameters(runner), "parameters after a refusal")
    runner.load(path, allow_drift=True)
    final = runner.learn(1)
    assert ckpt.read_manifest(final)["drifted"]
    assert not ckpt.read_manifest(path)["drifted"]


def test_weights_of_another_shape_are_refused_before_any_is_changed(tmp_path):
    path = make_runner(tmp_path).learn(1)
    data = ckpt.load_checkpoint(path)
    state = data.state
    state["algorithm"]["critic_state_dict"]["mlp.0.weight"] = torch.zeros(3, 3)
    bad = ckpt.save_checkpoint(tmp_path / "bad", state, Provenance(), iteration=1, env_steps=0)
    runner = make_runner()
    before = parameters(runner)
    for load in (runner.load, runner.load_weights):
        with pytest.raises(CheckpointError, match=r"critic has other shapes.*\s+mlp\.0\.weight: \(3, 3\), expected"):
            load(bad)
    compare(before, parameters(runner), "parameters after a refusal")


def drop_a_buffer(state):
    del state["processes"][0]["env"]["frames"]


def cut_a_buffer(state):
    state["processes"][0]["env"]["command"] = torch.zeros(3, 5)


def swap_a_counter(state):
    state["runner"]["next_iteration"] = "two"


def drop_the_learning_rate(state):
    del state["algorithm"]["learning_rate"]


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (drop_a_buffer, r"state\.process\.env\.frames: missing"),
        (cut_a_buffer, r"state\.process\.env\.command: \(3, 5\) torch\.float32, expected \(24, 5\)"),
        (swap_a_counter, r"state\.runner\.next_iteration: str, expected int"),
        (drop_the_learning_rate, r"state\.algorithm\.learning_rate: missing"),
    ],
)
def test_a_state_that_does_not_fit_is_refused_before_any_is_taken_over(tmp_path, damage, named):
    state = ckpt.load_checkpoint(make_runner(tmp_path).learn(1)).state
    damage(state)
    bad = ckpt.save_checkpoint(tmp_path / "bad", state, Provenance(), iteration=1, env_steps=0)
    runner, untouched = make_runner(), make_runner()
    with pytest.raises(CheckpointError, match=named):
        runner.load(bad)
    assert_same(untouched, runner)


def test_a_checkpoint_of_another_number_of_processes_is_refused(tmp_path):
    state = make_runner()._state()
    state["processes"] *= 2
    path = ckpt.save_checkpoint(tmp_path, state, Provenance(), iteration=1, env_steps=0)
    with pytest.raises(CheckpointError, match="written by 2 processes, resumed by 1"):
        make_runner().load(path)


def test_a_stage_starts_from_the_learner_of_another_with_fresh_counters(tmp_path):
    root = make_runner(tmp_path)
    path = root.learn(2)
    stage = make_runner(env=ToyEnv(8, ("two",)), seed=9)
    stage.load_weights(path)
    compare(parameters(root), parameters(stage), "weights")
    assert stage.current_learning_iteration == stage.env_steps == stage.alg.num_updates == 0
    assert stage.alg.learning_rate == root.alg.learning_rate != root.alg.cfg.learning_rate
    moments = [[s["exp_avg"] for s in runner.alg.optimizer.state_dict()["state"].values()] for runner in (root, stage)]
    assert moments[0], "the optimiser has no state to take over"
    assert all(torch.equal(*pair) for pair in zip(*moments, strict=True))


def test_imitation_alone_does_not_measure_its_steps_by_gradients_of_ppo(tmp_path):
    root = make_runner(tmp_path)
    stage = make_runner(use_ppo_loss=False)
    stage.load_weights(root.learn(2))
    compare(parameters(root), parameters(stage), "weights")
    assert not stage.alg.optimizer.state_dict()["state"]
    assert stage.alg.learning_rate == stage.alg.cfg.learning_rate


def test_first_episodes_are_staggered_unless_the_run_is_resumed(tmp_path):
    ages = []

    class Watched(ToyEnv):
        def step(self, actions):
            ages.append(self.episode_length_buf.clone())
            return super().step(actions)

    path = make_runner(tmp_path, Watched()).learn(1)
    assert ages[0].unique().numel() > 5
    resumed = make_runner(tmp_path, Watched())
    resumed.load(path)
    expected = resumed.env.episode_length_buf.clone()
    ages.clear()
    resumed.learn(1)
    assert torch.equal(ages[0], expected)


def test_progress_is_one_line_with_the_time_left(capsys):
    console = Console(force_terminal=False, width=200)
    scalars = {"Perf/total_fps": 3000.0, "Train/mean_reward": 1.5, "Train/mean_episode_length": 900.0}
    with ProgressReport("round1/distill", 0, 2, console) as progress:
        progress.update(1, 7680, scalars)  # too soon after the start for a line
        progress.update(2, 15360, scalars)
    out = capsys.readouterr().out
    assert out == "round1/distill 2/2 | 0.02M steps | 3000/s | reward 1.50 | length 900 | 0.0 min left\n"


def test_a_run_says_now_and_then_where_its_time_goes(capsys):
    times = {f"Perf/{name}_time": 1.0 for name in SECTIONS} | {"Perf/physics_time": 3.0}
    with ProgressReport("ppo", 0, 1000, Console(force_terminal=False, width=200)) as progress:
        for iteration in range(1, 2 * BUDGET_INTERVAL):
            progress.update(iteration, 1, times | {"Perf/total_fps": 1.0, "Perf/busy_cores": 1.25})
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("ppo time: physics 33%, MDP 11%, ")
    assert line.endswith(" | 1.2 cores busy")


def test_the_parts_of_an_iteration_are_logged_and_add_up_to_it(tmp_path, monkeypatch):
    clock = itertools.count().__next__
    monkeypatch.setattr("eagle_rl.algorithms.stopwatch.time.perf_counter", lambda: float(clock()))
    runner = make_runner(tmp_path)
    runner.learn(1)
    begin = clock()
    scalars = runner._iterate()
    end = clock()
    seconds = {name: scalars[f"Perf/{name}_time"] for name in SECTIONS}
    assert seconds.pop("physics") == 0.0, "the toy robots have none"
    assert all(s > 0 for s in seconds.values()), seconds
    assert end - begin - sum(seconds.values()) <= 3, "only what is read from the clock before and after"


def test_progress_draws_a_bar_on_a_terminal(capsys):
    console = Console(force_terminal=True, width=200)
    with ProgressReport("ppo", 0, 1, console) as progress:
        progress.update(1, 1, {"Perf/total_fps": 1.0})
    out = capsys.readouterr().out
    assert "ppo 1/1" in out
    assert "no episode over yet" in out


PROCESS = """
import sys, torch
from pathlib import Path
from eagle_rl.runners.team import Team
from tests.learner.helpers import make_runner, parameters
from tests.toy import ToyEnv
rank = int(sys.argv[2])
with Team():
    runner = make_runner(Path(sys.argv[1]), ToyEnv(12, seed=rank))
    runner.learn(2)
    torch.save(parameters(runner), f"{sys.argv[1]}/rank{rank}.pt")
"""


@pytest.mark.slow
def test_another_process_learns_the_same_bits_and_another_seed_others(tmp_path):
    code = PROCESS.replace("seed=rank)", "seed=0)")
    subprocess.run([sys.executable, "-c", code, str(tmp_path), "0"], cwd=ROOT, check=True, capture_output=True)
    there = torch.load(tmp_path / "rank0.pt", weights_only=True)
    for seed in (1, 2):
        here = make_runner(env=ToyEnv(12, seed=0), seed=seed)
        here.learn(2)
        same = [torch.equal(x, there[key]) for key, x in parameters(here).items()]
        assert all(same) if seed == 1 else not any(same), f"seed {seed}: {same}"


@pytest.mark.slow
def test_two_processes_train_one_policy(tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    env = os.environ | {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "OMP_NUM_THREADS": "1"}
    ranks = [
        subprocess.Popen(
            [sys.executable, "-c", PROCESS, str(tmp_path), str(rank)],
            cwd=ROOT,
            env=env | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(2)
    ]
    errors = [process.communicate(timeout=120)[1] for process in ranks]
    assert [process.returncode for process in ranks] == [0, 0], errors
    one, other = (torch.load(tmp_path / f"rank{rank}.pt", weights_only=True) for rank in range(2))
    compare(one, other, "parameters")
    state = ckpt.load_checkpoint(ckpt.latest_checkpoint(tmp_path / "checkpoints")).state
    assert len(state["processes"]) == 2
    assert state["runner"]["env_steps"] == 2 * 2 * 8 * 12
    frames = [process["env"]["frames"] for process in state["processes"]]
    assert not torch.equal(*frames), "both processes simulated the same"
