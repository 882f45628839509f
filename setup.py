"""Packaging. Configuration, robots and the published policy live at the top of the repository and travel inside."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent
DATA_FOLDERS = ("cfg", "assets", "checkpoints")


class BuildWithData(build_py):
    """Copy the data folders into the package being built; ``eagle_rl.paths.data_root`` finds them there."""

    def run(self) -> None:
        super().run()
        if self.editable_mode:
            return
        for name in DATA_FOLDERS:
            target = Path(self.build_lib) / "eagle_rl" / "data" / name
            shutil.rmtree(target, ignore_errors=True)
            shutil.copytree(ROOT / name, target, ignore=shutil.ignore_patterns("learner"))  # to train on from: 36 MB


def version() -> str:
    """The version, written once in ``eagle_rl/_version.py``."""
    match = re.search(r'__version__ = "(.+)"', (ROOT / "eagle_rl" / "_version.py").read_text(encoding="utf-8"))
    if match is None:
        raise RuntimeError("eagle_rl/_version.py holds no version")
    return match.group(1)


setup(
    name="eagle-rl",
    version=version(),
    description="One whole-body controller for a mixed fleet of humanoids: generalist-specialist distillation on CPU",
    long_description=(ROOT / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    python_requires=">=3.10,<3.14",
    packages=find_packages(include=["eagle_rl", "eagle_rl.*", "envs", "envs.*"]),
    cmdclass={"build_py": BuildWithData},
    scripts=["train.py", "play.py"],
    entry_points={"console_scripts": ["eagle = eagle_rl.cli.main:main"]},
    install_requires=[
        "torch>=2.13",
        "rsl-rl-lib>=5.5.1,<5.6",
        "tensordict>=0.7",
        "mujoco>=3.17",
        "pin>=4,<5",
        "gymnasium>=1.0",
        "numpy>=2.2",
        "typing_extensions>=4.10",
        "tensorboard>=2.18",
        "packaging>=24.0",
        "PyYAML>=6.0",
        "rich>=13.0",
        "imageio-ffmpeg>=0.4.9",
        "pillow>=10.1",
        "matplotlib>=3.10",
        "scikit-learn>=1.5.2",
        "safetensors>=0.4",
        "onnx>=1.17",
        "onnxscript>=0.6",
        "onnxruntime>=1.20",
    ],
    extras_require={
        "dev": [
            "build>=1.0",
            "setuptools>=70.1",
            "pytest>=8.0",
            "pytest-cov>=5.0",
            "hypothesis>=6.100",
            "ruff>=0.12",
            "mypy>=1.13",
            "types-PyYAML>=6.0",
        ],
    },
    classifiers=[
        "Programming Language :: Python :: 3",
        "Programming Language :: Python :: 3.10",
        "Programming Language :: Python :: 3.11",
        "Programming Language :: Python :: 3.12",
        "Programming Language :: Python :: 3.13",
        "Topic :: Scientific/Engineering :: Artificial Intelligence",
    ],
)
