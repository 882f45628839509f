"""What a user can get wrong: one message, the right exit code, no traceback, and every file as it was."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from eagle_rl.cli.main import run_verb
from eagle_rl.config.load import load_experiment, to_yaml
from eagle_rl.paths import data_root
from eagle_rl.runners import checkpoint as ckpt
from tests.policy import untrained_checkpoint

ROOT = Path(__file__).parents[2]


def everything(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def refused(tmp_path, capsys):
    """Runs a verb that must fail with a code and a message, and leave the folder as it was."""

    def check(words: list[str], code: int, *parts: str) -> None:
        before = everything(tmp_path)
        try:
            got = run_verb(words[0], words[1:])
        except SystemExit as error:  # argparse
            got = error.code
        message = capsys.readouterr().err
        assert got == code, message
        assert "Traceback" not in message
        for part in parts:
            assert part in message
        assert everything(tmp_path) == before

    return check


@pytest.fixture
def checkpoint(tmp_path) -> Path:
    return untrained_checkpoint(tmp_path / "checkpoints", "h1")


def robot_file(folder: Path, urdf: str) -> Path:
    """H1's YAML with another URDF."""
    text = (data_root() / "cfg/robots/h1.yaml").read_text(encoding="utf-8")
    path = folder / "mine.yaml"
    path.write_text(text.replace("../../assets/urdf/h1.urdf", urdf), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["pppo"], 2, "Did you mean ppo?"),
        (["ppo", "robots=[h1, g2]"], 3, "Did you mean g1?"),
        (["ppo", "task.rewards.weigths.alive=1"], 2, "Did you mean weights?"),
        (["ppo", "algo.gamma=high"], 2, "algo.gamma: got 'high', expected a number"),
        (["ppo", "num_envs=3.5"], 2, "num_envs: got 3.5"),
        (["ppo", "--out", "taken"], 2, "Choose another with --out"),
        (["--resume", "."], 5, "not a run directory"),
        (["ppo", "--device", "tpu"], 2, "expected cpu, cuda"),
        (["ppo", "--jobs", "0"], 2, "expected a whole number above 0"),
        (["ppo", "--jobs", "6"], 2, "--jobs 6: at most one specialist a robot"),
        (["taken.yaml"], 2, "taken.yaml: holds no experiment"),
    ],
)
def test_a_command_typed_into_a_shell_is_refused_within_its_message(tmp_path, words, code, message):
    (tmp_path / "taken").write_text("a file")
    (tmp_path / "taken.yaml").write_text("# nothing yet")
    command = [sys.executable, str(ROOT / "train.py"), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ)
    assert done.returncode == code, done.stderr
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert everything(tmp_path) == {tmp_path / "taken": b"a file", tmp_path / "taken.yaml": b"# nothing yet"}


def test_every_fault_of_a_file_is_in_one_message(refused):
    text = to_yaml(load_experiment("ppo")).replace("gamma:", "gama:").replace("\nnum_envs: ", "\nnum_envs: many # ")
    Path("mine.yaml").write_text(text)
    refused(["train", "mine.yaml"], 2, "num_envs: got 'many'", "Did you mean gamma?")


def test_a_missing_urdf_is_named(refused, tmp_path):
    path = robot_file(tmp_path, "gone.urdf")
    for words in (["train", "smoke", f"robots=[{path}]"], ["robots", "check", str(path)]):
        refused(words, 3, "gone.urdf", "Check `urdf`")


def test_a_link_without_mass_is_named(refused, tmp_path):
    urdf = (data_root() / "assets/urdf/h1.urdf").read_text(encoding="utf-8")
    start = urdf.index('<mass value="', urdf.index('<link name="left_knee_link"'))
    urdf = urdf[:start] + '<mass value="0"/>' + urdf[urdf.index("/>", start) + 2 :]
    (tmp_path / "light.urdf").write_text(urdf, encoding="utf-8")
    path = robot_file(tmp_path, "light.urdf")
    for words in (["train", "smoke", f"robots=[{path}]"], ["robots", "check", str(path)]):
        refused(words, 3, "left_knee_link", "mass is 0 kg, expected more than 0")


USES = (["play"], ["evaluate"], ["export"], ["plot", "response"])
"""Every verb that takes a policy."""


@pytest.mark.parametrize("verb", USES, ids=" ".join)
def test_a_policy_of_another_slot_table_is_refused(refused, checkpoint, verb):
    manifest = ckpt.read_manifest(checkpoint) | {"slot_table_hash": "0123456789abcdef"}
    checkpoint.with_suffix(".json").write_bytes(ckpt._encode_manifest(manifest))
    refused([*verb, str(checkpoint)], 5, "another slot table (0123456789ab)", checkpoint.name)


@pytest.mark.parametrize("verb", USES, ids=" ".join)
def test_a_damaged_checkpoint_is_refused_by_name(refused, checkpoint, verb):
    whole = checkpoint.read_bytes()
    checkpoint.write_bytes(whole[: len(whole) // 2])
    refused([*verb, str(checkpoint)], 5, f"{checkpoint.name}: damaged: {len(whole) // 2} bytes")
    middle = len(whole) // 2
    checkpoint.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    refused([*verb, str(checkpoint)], 5, f"{checkpoint.name}: damaged: its sha256")


@pytest.mark.parametrize("verb", USES, ids=" ".join)
def test_where_no_checkpoint_is_it_is_said_so(refused, verb):
    refused([*verb, "."], 5, ".: no checkpoint there")


@pytest.mark.parametrize("verb", [*USES, ["plot", "rounds"], ["plot", "curves"], ["status"], ["sim2sim"]], ids=" ".join)
def test_where_nothing_is_it_is_said_so_with_the_nearest_name(refused, verb):
    more = ["--robot", "h1"] if verb == ["sim2sim"] else []
    Path("none.pt").write_text("")
    code = 2 if verb == ["plot", "curves"] else 5
    refused([*verb, "nowhere", *more], code, "error: nowhere: no such folder.")
    refused([*verb, "nope.pt", *more], code, "error: nope.pt: no such file. Did you mean none.pt?")


@pytest.mark.parametrize("verb", [*USES, ["plot", "rounds"], ["plot", "curves"], ["status"], ["train", "--resume"]])
def test_where_a_run_is_expected_the_runs_in_a_folder_are_listed_newest_first(refused, verb):
    for age, name in enumerate("CADBE"):
        run = Path("logs/smoke") / name
        run.mkdir(parents=True)
        (run / "plan.json").write_text("{}")
        os.utime(run / "plan.json", (0, 10 - age))
    for folder in ("logs", "logs/smoke"):
        listed = ", ".join(f"logs/smoke/{name}" for name in "CADB")
        refused([*verb, folder], 2 if verb[-1] == "curves" else 5, f"There, newest first: {listed} and 1 more.")


def test_policies_in_a_folder_are_listed(refused):
    Path("weights").mkdir()
    Path("weights/mine.safetensors").write_text("")
    refused(["play", "weights"], 5, "a NAME.safetensors", "newest first: weights/mine.safetensors")


def test_other_files_than_a_verb_takes_are_refused_in_its_own_words(refused):
    Path("mine.safetensors").write_bytes(b"\xb0" * 9)
    refused(["plot", "curves", "mine.safetensors"], 2, "mine.safetensors: holds no curves. Name a run")
    Path("mine.onnx").write_bytes(b"nothing")
    refused(["sim2sim", ".", "--robot", "h1"], 5, ".: a folder, expected a file", "newest first: mine.onnx")
    refused(["sim2sim", "mine.onnx", "--robot", "h1"], 5, "mine.onnx: cannot be opened as ONNX: Load model")


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["evaluate", "--envs", "0"], 2, "--envs: got '0', expected a whole number above 0"),
        (["evaluate", "--steps", "-5"], 2, "--steps: got '-5'"),
        (["evaluate", "--envs", "10000000"], 2, "--envs: got '10000000', expected at most 1000000"),
        (["evaluate", "--resample", "nan"], 2, "--resample: got 'nan', expected a time"),
        (["evaluate", "--device", "tpu"], 2, "--device: got 'tpu'"),
        (["evaluate", "--robots", "g2"], 3, "Did you mean g1?"),
        (["evaluate", "--out", "taken/here"], 2, "taken is a file"),
        (["plot", "curves", "--out", "taken"], 2, "taken is a file"),
        (["plot", "latents", "--envs", "1.5"], 2, "--envs: got '1.5'"),
        (["export", "--out", "nowhere/p.onnx"], 2, "there is no folder nowhere"),
        (["export", "--out", "."], 2, "expected the name of a file that ends in .onnx"),
        (["export", "--publish", "."], 2, "--publish .: expected a name"),
        (["play", "--video", "nowhere/v.mp4"], 2, "there is no folder nowhere"),
        (["play", "--video", "folder.mp4"], 2, "folder.mp4: is a folder"),
        (["play", "--commands", "taken"], 2, "taken"),
        (["play", "--seconds", "nan"], 2, "--seconds: got 'nan'"),
        (["play", "--seconds", "0"], 2, "expected a time above zero"),
    ],
)
def test_a_wrong_option_is_named(refused, checkpoint, words, code, message):
    Path("taken").write_text("a file")
    Path("folder.mp4").mkdir()
    refused([words[0], *words[1:-2], str(checkpoint), *words[-2:]], code, message)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": 0}', "\0"])
def test_a_file_that_is_no_evaluation_is_refused_by_name(refused, text):
    Path("result.json").write_text(text)
    refused(["evaluate", "result.json"], 5, "result.json: not a result of eagle evaluate")


def test_status_of_a_folder_that_is_no_run_is_refused(refused):
    refused(["status", "."], 5, "not a run directory: it has no plan.json")


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"stages": [{}]}', '{"stages": 1, "provenance": 2}', "\0", "[" * 10_000]
)
@pytest.mark.parametrize("verb", [["status"], ["plot", "curves"], ["plot", "rounds"], ["evaluate"]], ids=" ".join)
def test_a_run_whose_plan_is_damaged_is_refused_by_name(refused, text, verb):
    Path("plan.json").write_text(text)
    refused([*verb, "."], 5, "plan.json: damaged")


@pytest.mark.parametrize("text", ["x}", '{"Train/mean_reward/h1": 1}', '[]\n{"a": {}}}', "\xff"])
def test_numbers_that_no_run_wrote_are_refused_by_name(refused, text):
    Path("metrics.jsonl").write_bytes(text.encode("latin1"))
    refused(["plot", "curves", "."], 2, "metrics.jsonl: not the numbers of a run")


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"Train/mean_rew'])
def test_where_no_numbers_are_yet_it_is_said_so(refused, text):
    Path("metrics.jsonl").write_text(text)
    refused(["plot", "curves", "."], 2, ".: nothing to draw yet")


def test_a_file_the_system_refuses_is_named_without_a_traceback(refused, monkeypatch):
    def full(*args):
        raise OSError(28, "No space left on device", "logs/table.md")

    monkeypatch.setattr("eagle_rl.cli.doctor.main", full)
    refused(["doctor"], 2, "error: logs/table.md: No space left on device.")
