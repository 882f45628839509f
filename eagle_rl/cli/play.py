"""``eagle play``: a checkpoint in motion, several robots side by side, in a browser, a window or as a video."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from eagle_rl.config.commands import CommandScript, load_commands
from eagle_rl.config.compose import known_names
from eagle_rl.config.validate import CONTROL_STEP
from eagle_rl.errors import CheckpointError, ConfigError
from eagle_rl.paths import data_root, shown

from .arguments import duration
from .policy import chosen_robots, load_policy

if TYPE_CHECKING:
    from .session import Session

SHEET_FRAMES = 12
SIZE = (1280, 720)
FRAME_STEPS = 2
"""Control steps per frame of a video: 25 frames per second."""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="eagle play",
        description="Show a checkpoint on several robots side by side. Without a display a video is made in the "
        "folder you are in.",
        epilog="Example: python play.py logs/quickstart/RUN --robots h1,g1 --video two.mp4",
    )
    parser.add_argument(
        "checkpoint",
        nargs="?",
        type=Path,
        metavar="CKPT",
        help="checkpoint, stage or run [the published policy]",
    )
    parser.add_argument("--last", action="store_true", help="show the newest run in logs/")
    parser.add_argument("--robots", metavar="A,B|all", help="robots to show [those it was trained on]")
    parser.add_argument(
        "--viewer",
        choices=("web", "native", "none"),
        help="web serves browsers, native opens a window [native if there is a display and no file is asked for]",
    )
    parser.add_argument("--video", type=Path, metavar="FILE.mp4", help="write a video")
    parser.add_argument("--contact-sheet", type=Path, metavar="FILE.png", help="write twelve frames as one picture")
    parser.add_argument(
        "--commands",
        metavar="SCRIPT",
        help=f"command script, a YAML file or one of {', '.join(known_names('commands'))}",
    )
    parser.add_argument("--seconds", type=duration, metavar="S", help="stop after so long [the script's end]")
    parser.add_argument(
        "--replay-fault", type=Path, metavar="FILE.npz", help="show the last states of a sick environment instead"
    )
    return parser


def has_display() -> bool:
    """Whether a window can be opened, as far as the environment tells."""
    if sys.platform != "linux":
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


PUBLISHED = data_root() / "checkpoints" / "generalist.safetensors"
"""The policy that comes with the package."""


def newest_run(logs: Path = Path("logs")) -> Path:
    """The run directory in ``logs`` whose checkpoints are newest.

    Raises:
        CheckpointError: there is none.
    """
    manifests = list(logs.glob("*/*/**/model_*.json"))
    if not manifests:
        raise CheckpointError(f"no checkpoint named, and no run in {logs}/ to take one from. Train one: make train.")
    newest = max(manifests, key=lambda path: path.stat().st_mtime)
    return logs.joinpath(*newest.relative_to(logs).parts[:2])


def _chosen(args: argparse.Namespace) -> Path:
    """What is to be shown; without a word of it the published policy, where it was not left out of the installation."""
    if args.last or not (args.checkpoint or PUBLISHED.is_file()):
        return newest_run()
    return args.checkpoint or PUBLISHED


def _load(args: argparse.Namespace, checkpoint: Path, seconds: float) -> Session:
    """The policy and its robots, ready to move."""
    from .session import Session

    policy = load_policy(checkpoint)
    names = chosen_robots(args.robots, policy.cfg)
    return Session(policy.act, policy.cfg, names, num_steps=round(seconds / CONTROL_STEP))


def main(argv: Sequence[str]) -> int:
    """Run ``eagle play``."""
    args = _parser().parse_args(argv)
    if args.last and args.checkpoint is not None:
        raise ConfigError(f"--last and {args.checkpoint}: --last is the newest run in logs/. Give one of them.")
    files = args.video or args.contact_sheet
    viewer = args.viewer or ("native" if has_display() and not files else "none")
    if viewer == "native" and not has_display():
        raise ConfigError("--viewer native needs a display, and there is none here. Make a video: --video robots.mp4")
    script = load_commands(args.commands or "demo")

    from envs.rendering.recorder import check_writable

    for path, suffix in ((args.video, ".mp4"), (args.contact_sheet, ".png")):
        if path is not None:
            check_writable(path, suffix)
    if args.replay_fault is not None:
        from .replay import replay

        replay(args.replay_fault, args.video, args.contact_sheet, SIZE)
        return 0

    from eagle_rl.runners.locate import find_checkpoint

    checkpoint = find_checkpoint(_chosen(args))
    print(f"playing {shown(checkpoint)}", file=sys.stderr)
    if viewer == "none":
        seconds = args.seconds or script.duration
        video = args.video if files else Path(checkpoint.name).with_suffix(".mp4")
        film(_load(args, checkpoint, seconds), script, seconds, video, args.contact_sheet)
    else:
        watch = _viewer(viewer)
        watch(_load(args, checkpoint, args.seconds or 1e6), script if args.commands else None, args.seconds)
    return 0


def _viewer(kind: str) -> Callable[[Session, CommandScript | None, float | None], None]:
    """The function that shows a session live."""
    if kind == "native":
        from .window import watch

        return watch
    try:
        from .browser import serve
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"--viewer web needs {error.name}: pip install viser. Or make a video: --video robots.mp4"
        ) from error
    return serve


def film(session: Session, script: CommandScript, seconds: float, video: Path | None, sheet: Path | None) -> None:
    """Record a script as a video, a contact sheet, or both."""
    from rich.console import Console
    from rich.progress import track

    from envs.rendering.offscreen import OffscreenRenderer
    from envs.rendering.recorder import captioned, contact_sheet, evenly, save_picture, video_writer
    from envs.rendering.scene import Stage

    from .session import caption

    num_steps = max(1, round(seconds / session.step_dt))
    picks = set(evenly(num_steps, SHEET_FRAMES)) if sheet is not None else set()
    picked = []
    console = Console(stderr=True)
    with contextlib.ExitStack() as stack:
        renderer = stack.enter_context(OffscreenRenderer(Stage(session.specs), *SIZE))
        fps = 1.0 / (FRAME_STEPS * session.step_dt)
        write = stack.enter_context(video_writer(video, *SIZE, fps)) if video is not None else None
        for step in track(range(num_steps), "filming", console=console, transient=True):
            command = script.at(session.time)
            session.step(command)
            renderer.show(session.qpos)
            in_video = write is not None and step % FRAME_STEPS == 0
            if not in_video and step not in picks:
                continue
            frame = captioned(renderer.frame(), caption(session.time, command))
            if in_video and write is not None:
                write(frame)
            if step in picks:
                picked.append(frame)
    if sheet is not None:
        save_picture(sheet, contact_sheet(picked))
    _report(session, [path for path in (video, sheet) if path is not None])


def _report(session: Session, files: Sequence[Path]) -> None:
    """Say what was written and who fell."""
    for name, falls in session.falls.items():
        times = ", ".join(f"{t:.1f}" for t in falls[:8]) + (", ..." if len(falls) > 8 else "")
        print(f"{name:<8} " + (f"fell {len(falls)} times, at {times} s" if falls else f"{session.time:.1f} s, no fall"))
    for path in files:
        print(path)
