"""The loader: layers, strict types, and messages that say everything at once."""

from __future__ import annotations

import dataclasses
import functools
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eagle_rl.config import validate
from eagle_rl.config.build import RETIRED
from eagle_rl.config.compose import known_names
from eagle_rl.config.load import experiment_from_plain, load_experiment, to_yaml
from eagle_rl.config.schema import ExperimentCfg, RewardWeightsCfg
from eagle_rl.config.validate import leaves
from eagle_rl.errors import ConfigError, RobotError

EXPERIMENTS = known_names("experiment")


def faults_of(*overrides: str, name: str = "ppo") -> list[str]:
    with pytest.raises(ConfigError) as caught:
        load_experiment(name, overrides)
    return caught.value.faults


def write(text: str) -> str:
    Path("mine.yaml").write_text(text, encoding="utf-8")
    return "mine.yaml"


@pytest.mark.parametrize("scale", [None, *known_names("scale")])
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_shipped_experiment_loads_at_every_scale(name, scale):
    cfg = load_experiment(name, scale=scale)
    assert cfg.name == name
    assert cfg.description, "an experiment says what it is"


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_a_resolved_experiment_reads_back_as_itself(name):
    cfg = load_experiment(name)
    again = load_experiment(write(to_yaml(cfg)))
    assert again == cfg


@pytest.mark.parametrize(("key", "off"), RETIRED.items())
def test_a_stored_configuration_with_a_key_of_an_earlier_version_loads_where_that_was_off(key, off):
    *parents, last = key.split(".")

    def stored(value):
        return functools.reduce(lambda inner, parent: {parent: inner}, reversed(parents), {last: value})

    assert experiment_from_plain(stored(off), "old") == ExperimentCfg(name="stored")
    with pytest.raises(ConfigError, match=f"{key}: no such key"):
        experiment_from_plain(stored(1.0), "old")


def test_a_whole_configuration_is_written_down_in_the_resolved_file():
    text = to_yaml(load_experiment("ppo"))
    for field in dataclasses.fields(RewardWeightsCfg):
        assert f"{field.name}:" in text


def test_the_papers_task_is_the_printed_table_without_aids():
    task = load_experiment("ppo", ["task=paper"]).task
    assert task.rewards.orientation == "upright"
    assert (task.aids.harness, task.aids.gait_shaping) == (0.0, 0.0)


def test_without_embodiment_observation_differs_from_the_root_in_that_alone():
    root, without = (dict(leaves(load_experiment(name))) for name in ("published", "ppo_no_eo"))
    changed = {key for key in root if root[key] != without[key]}
    assert changed == {"name", "description", "task.observations.embodiment_observation"}


def test_scale_paper_has_4096_environments_and_hugwbcs_ppo():
    cfg = load_experiment("eagle", scale="paper")
    assert cfg.num_envs == 4096
    assert (cfg.algo.num_learning_epochs, cfg.algo.num_mini_batches, cfg.algo.entropy_coef) == (5, 4, 0.01)
    assert cfg.algo.learning_rate_range == (1e-5, 1e-2)
    assert (cfg.algo.lam, cfg.algo.desired_kl) == (0.95, 0.01)


def test_later_layers_win_file_then_scale_then_command_line():
    assert load_experiment("smoke").num_envs == 10
    assert load_experiment("smoke", scale="paper").num_envs == 4096
    assert load_experiment("smoke", ["num_envs=40"], scale="paper").num_envs == 40


def test_one_bound_of_a_command_keeps_the_other_bounds():
    cfg = load_experiment("ppo", ["task.commands.lin_vel_x.initial=[-0.1, 0.1]"])
    assert cfg.task.commands.lin_vel_x.initial == (-0.1, 0.1)
    assert cfg.task.commands.lin_vel_x.finishing == (-0.6, 1.2)


def test_naming_a_task_starts_it_afresh_and_its_own_keys_come_on_top():
    path = write("base: ppo\ntask: {base: paper, gait: {frequency: 2}}\n")
    task = load_experiment(path).task
    assert task.rewards.orientation == "upright"
    assert task.gait.frequency == 2.0
    assert isinstance(task.gait.frequency, float)


def test_a_base_given_as_a_path_is_looked_for_beside_its_file():
    Path("mine").mkdir()
    Path("mine/first.yaml").write_text("base: ppo\nseed: 7\n", encoding="utf-8")
    Path("mine/second.yaml").write_text("base: first.yaml\n", encoding="utf-8")
    assert load_experiment("mine/second.yaml").seed == 7


def test_a_group_given_as_a_path_is_looked_for_beside_the_file_it_is_written_in():
    Path("mine").mkdir()
    Path("slow.yaml").write_text("gait: {frequency: 1}\n", encoding="utf-8")
    Path("mine/quick.yaml").write_text("gait: {frequency: 3}\n", encoding="utf-8")
    Path("mine/named.yaml").write_text("base: ppo\ntask: quick.yaml\n", encoding="utf-8")
    Path("mine/within.yaml").write_text("base: ppo\ntask: {base: quick.yaml}\n", encoding="utf-8")
    Path("inherits.yaml").write_text("base: mine/named.yaml\n", encoding="utf-8")
    for name in ("mine/named.yaml", "mine/within.yaml", "inherits.yaml"):
        assert load_experiment(name).task.gait.frequency == 3.0, name
    assert load_experiment("mine/named.yaml", ["task=slow.yaml"]).task.gait.frequency == 1.0, "as on any command line"


def test_a_path_names_the_experiment_after_its_file():
    assert load_experiment(write("base: ppo\n")).name == "mine"


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("algo.gama=0.9", "command line: algo.gama: no such key. Did you mean gamma?"),
        ("num_mini_batches=4", "Did you mean algo.num_mini_batches?"),
        ("algo.gamma=high", "algo.gamma: got 'high', expected a number."),
        ("algo.gamma='0.9'", "algo.gamma: got '0.9', expected a number."),
        ("algo.gamma=true", "algo.gamma: got True, expected a number."),
        ("num_envs=64.0", "num_envs: got 64.0, expected an integer."),
        ("num_envs=true", "num_envs: got True, expected an integer."),
        ("task.sim.self_collision=1", "got 1, expected true or false."),
        ("task.sim.self_collision=yes", "got 'yes', expected true or false."),
        ("task.terrain.kind=slope", "expected one of plane, rough, slopes, steps. Did you mean slopes?"),
        ("robots=h1", "got 'h1', expected a list of names such as [h1, g1]."),
        ("algo.network.actor_dims=[64, wide]", "expected a list of integers."),
        ("task.randomization.friction=[1]", "expected a list of 2 numbers."),
        ("task.rewards=none", "task.rewards: got 'none', expected keys and values."),
        ("algo.gamma={a: 1}", "algo.gamma: got {'a': 1}, expected a number."),
        ("task=papr", "no task named 'papr'. Did you mean paper?"),
        ("algo.gamma", "'algo.gamma': expected key.sub=value"),
        ("algo.gamma=[1", "command line: 'algo.gamma=[1'"),
        ("algo.gamma=!!float 1", "tags (tag:yaml.org,2002:float) are not allowed."),
    ],
)
def test_a_wrong_override_is_named_with_what_was_expected(override, expected):
    (fault,) = faults_of(override)
    assert expected in fault


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("num_envs=0", "num_envs: got 0, expected above 0"),
        ("num_envs=4", "4 is less than one environment for each of 5 robots"),
        ("task.sim.physics_dt=0.004", "physics_dt 0.004 x decimation 2 is 0.008 s, expected 0.02 s"),
        ("evaluation.decimation=2", "evaluation.decimation: physics_dt 0.005 x decimation 2 is 0.01 s"),
        ("task.commands.standing_probability=1.5", "expected from 0 to 1"),
        ("task.randomization.friction=[2, 1]", "expected the lower bound first"),
        ("task.randomization.link_mass_scale=[0, 1]", "expected numbers above 0"),
        ("task.rewards.weights.termination=200", "expected 0 or less, it is a penalty"),
        ("task.rewards.weights.alive=-1", "expected 0 or more, it is a reward"),
        ("task.gait.frequency=.nan", "got nan, expected a finite number"),
        ("task.randomization.sensing_latency_s=[0, 0.04]", "expected from 0 to 0.02 s, a control step"),
        ("task.gait.stance_ratio=0.2", "got 0.2, expected at least 0.35 and below 1"),
        ("task.randomization.motor_offset=[-.inf, 0]", "expected finite numbers"),
        ("task.randomization.motor_offset=[0, .nan]", "expected finite numbers"),
        ("num_envs=1000000000000", "expected at most 1e+06"),
        ("seed=-1", "expected 0 or more"),
        ("algo.network.actor_dims=[1000000000]", "of at most 100000"),
        ("algo.num_mini_batches=7", "7 does not divide the batch of num_envs 320 x num_steps_per_env 24 = 7680"),
        ("algo.learning_rate=0.1", "0.1 is outside learning_rate_range [1e-05, 0.002]"),
        ("algo.network.init_std=2", "2 is outside std_range [0.1, 1"),
        ("algo.network.actor_dims=[64, 0]", "expected numbers above 0"),
        ("algo.network.encoder_dims=[]", "algo.network.encoder_dims: got [], expected at least one layer"),
        ("task.commands.ang_vel_z.initial=[-2, 2]", "the curriculum only widens"),
        ("task.observations.scan_x=[0, 1, 0]", "at least one point"),
        ("robots=[]", "robots: expected at least one robot"),
        ("robots=[h1, g1, h1]", "named twice: h1; "),
        ("plan.method=eagle", "needs a budget for this stage"),
        ("plan.teachers=[generalist]", "plan.teachers: 1 named, expected one for each of 5 robots"),
        ("plan.teachers=[a, a, a, a, a]", "plan.teachers: got ['a', 'a', 'a', 'a', 'a'], but method ppo has no rounds"),
        ("plan.search_env_steps=9", "plan.search_env_steps: got 9, but method ppo has no rounds"),
        ("plan.correction_env_steps=9", "plan.correction_env_steps: got 9, but method ppo has no rounds"),
        ("plan.max_rounds=2", "plan.max_rounds: got 2, but method ppo has no rounds"),
        ("plan.start_share=0.5", "plan.start_share: got 0.5, but method ppo has no rounds"),
        ("algo.use_ppo_loss=false", "algo.use_ppo_loss: got False, but method ppo has no rounds"),
        ("correction.num_steps=64", "correction.num_steps: got 64, expected 65 or more, to look ahead"),
        ("search.num_steps=40", "search.num_steps: got 40, expected more than search.settling_steps, 40"),
        ("search.error_units=[0.05, 0.08, 0, 0.02, 0.04]", "expected numbers above 0"),
        ("run.device=tpu", "expected cpu, cuda or cuda:N"),
        ("name=../escape", "it names the run's folder"),
    ],
)
def test_an_impossible_value_is_named_with_its_bound(override, expected):
    faults = faults_of(override)
    assert all(f.startswith("command line: ") for f in faults)
    assert any(expected in fault for fault in faults), faults


def test_a_search_may_take_the_place_of_specialists_training_but_not_of_residuals():
    overrides = ["plan.specialist_env_steps=0", "plan.search_env_steps=9"]
    assert load_experiment("eagle", overrides).plan.search_env_steps == 9
    (fault,) = faults_of(*overrides, name="fork_compass")
    assert "plan.search_env_steps: got 9, but method compass has no rounds; leave it out" in fault


def test_robots_whose_stages_would_have_one_name_are_refused():
    for folder in ("a", "b"):
        Path(folder).mkdir()
        Path(folder, "h1.yaml").touch()
    for robots in ("h1, a/h1.yaml", "a/h1.yaml, b/h1.yaml"):
        assert f"robots: named twice: {robots}; expected files" in faults_of(f"robots=[{robots}]", name="eagle")[0]


def test_minibatches_divide_the_batch_of_specialists_too():
    few = ["num_envs=350", "algo.num_mini_batches=7", "plan.specialist_num_envs=64"]
    (fault,) = faults_of(*few, name="eagle")
    assert "7 does not divide the batch of plan.specialist_num_envs 64 x num_steps_per_env 24 = 1536" in fault
    load_experiment("eagle", [*few, "plan.specialist_env_steps=0", "plan.search_env_steps=9"])


def test_specialists_need_a_budget_only_where_some_are_trained():
    nothing, given = "plan.specialist_env_steps=0", "generalist, generalist, generalist, generalist"
    load_experiment("eagle", [nothing, f"plan.teachers=[{given}, a.pt]", "plan.max_rounds=1"])
    for teachers, rounds in ((f"[{given}, specialist]", 1), (f"[{given}, a.pt]", 2), ("[]", 1)):
        with pytest.raises(ConfigError, match=r"plan.specialist_env_steps: 0, but method eagle needs"):
            load_experiment("eagle", [nothing, f"plan.teachers={teachers}", f"plan.max_rounds={rounds}"])


def test_a_correction_has_passes_or_foresight_or_both():
    for alone in ("correction.std=0", "correction.foresight_std=0"):
        load_experiment("fork_correct", [alone])
    with pytest.raises(ConfigError, match=r"correction.std: 0, and so is correction.foresight_std"):
        load_experiment("fork_correct", ["correction.std=0", "correction.foresight_std=0"])


def test_every_bound_is_that_of_a_key():
    keys = {key for key, _ in leaves(ExperimentCfg(name="x"))}
    assert {*validate.BOUNDS, *validate.CEILINGS, *validate.POSITIVE_ITEMS} <= keys


def test_a_default_that_clashes_with_a_value_is_reported_where_the_value_was_written():
    path = write("base: ppo\nalgo:\n  num_mini_batches: 7\n")
    (fault,) = faults_of(name=path)
    assert fault.startswith("mine.yaml:3: algo.num_mini_batches: ")


def test_all_faults_of_file_and_command_line_come_in_one_message():
    path = write("base: ppo\nnum_envz: 3\nalgo:\n  gamma: high\n  lamda: 1\nrobots: [h1, g2]\n")
    faults = faults_of("task.sim.decimation=3", name=path)
    text = "\n".join(faults)
    for part in (
        "mine.yaml:2: num_envz: no such key. Did you mean num_envs?",
        "mine.yaml:4: algo.gamma: got 'high'",
        "mine.yaml:5: algo.lamda: no such key. Did you mean lam?",
        "mine.yaml:6: robots: no robot named 'g2'. Did you mean g1?",
        "command line: task.sim.decimation: ",
    ):
        assert part in text
    assert len(faults) == 5


def test_only_an_unknown_robot_is_a_robots_fault():
    with pytest.raises(RobotError, match=r"no robot named 'g2'\. Did you mean g1\?") as caught:
        load_experiment("ppo", ["robots=[h1, g2]"])
    assert caught.value.exit_code == 3


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("num_envs: 64\nnum_envs: 65\n", "mine.yaml:2: key 'num_envs' is given twice."),
        ("x: !!python/object/apply:os.system [true]\n", "mine.yaml:1: tags"),
        ("a: &a [1]\nb: *a\n", "mine.yaml:2: aliases (*name) are not allowed."),
        ("a: " + "[" * 40 + "]" * 40, "nested deeper than 16 levels"),
        ("- 1\n", "expected keys and values at the top level, got list"),
        ("1: 2\n", "key '1' is not text"),
        ("a: [1\n", "mine.yaml:"),
        ("base: pppo\n", "mine.yaml:1: no experiment named 'pppo'. Did you mean ppo?"),
        ("base: [ppo]\n", "mine.yaml:1: base: got ['ppo'], expected the name of a file."),
        ("base: mine.yaml\n", "base files run in a circle"),
        ("a: 1\n---\nb: 1\n", "but found another document"),
        ("seed: " + "9" * 5000, "mine.yaml"),
    ],
)
def test_a_hostile_or_broken_file_is_refused_in_words(text, expected):
    with pytest.raises(ConfigError, match=re.escape(expected)):
        load_experiment(write(text))


@pytest.mark.parametrize(("content", "expected"), [(b"\xff\xfe\x00", "not UTF-8"), (b"#" * (2 << 20), "larger than")])
def test_what_is_not_a_configuration_file_is_refused(content, expected):
    Path("mine.yaml").write_bytes(content)
    with pytest.raises(ConfigError, match=expected):
        load_experiment("mine.yaml")


def test_a_missing_file_is_named():
    with pytest.raises(ConfigError, match=r"none\.yaml: cannot be read: No such file"):
        load_experiment("none.yaml")


def test_numbers_are_read_as_yaml_1_2_reads_them():
    cfg = load_experiment("ppo", ["algo.learning_rate=1e-4", "plan.generalist_env_steps=1_000", "robots=[n1]"])
    assert (cfg.algo.learning_rate, cfg.plan.generalist_env_steps, cfg.robots) == (1e-4, 1000, ("n1",))


share = st.floats(0.01, 0.99)
positive = st.floats(1e-3, 1e3)
ordered = st.lists(st.floats(-5, 5), min_size=2, max_size=2).map(sorted).map(tuple)


@given(
    seed=st.integers(0, 2**31 - 1),
    num_envs=st.integers(5, 10_000).map(lambda n: 4 * n),
    gamma=share,
    frequency=positive,
    offset=ordered,
    orientation=st.sampled_from(["upright", "commanded"]),
    dims=st.lists(st.integers(1, 512), min_size=1, max_size=4).map(tuple),
    description=st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), max_size=30),
    root=st.none() | st.sampled_from(["a.pt", "null", "1e3", "~", "yes"]),
)
def test_any_configuration_survives_being_written_and_read(
    seed, num_envs, gamma, frequency, offset, orientation, dims, description, root
):
    base = load_experiment("ppo")
    replace = dataclasses.replace
    task = replace(
        base.task,
        gait=replace(base.task.gait, frequency=frequency),
        randomization=replace(base.task.randomization, motor_offset=offset),
        rewards=replace(base.task.rewards, orientation=orientation),
    )
    algo = replace(base.algo, gamma=gamma, network=replace(base.algo.network, actor_dims=dims))
    plan = replace(base.plan, root=root)
    cfg: ExperimentCfg = replace(
        base, seed=seed, num_envs=num_envs, task=task, algo=algo, plan=plan, description=description
    )
    assert load_experiment(write(to_yaml(cfg))) == cfg
