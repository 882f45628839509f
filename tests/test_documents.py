"""Documents lead to each other: links have a file at their end, and README leads to every document."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "checkpoints" / "README.md",
             *sorted((ROOT / "docs").glob("*.md")), ROOT / "docs" / "results" / "README.md"]  # fmt: skip


def links(document: Path) -> list[str]:
    """Relative targets of a document's links and pictures."""
    targets = re.findall(r"\]\(([^)\s]+)\)", document.read_text(encoding="utf-8"))
    return [target.split("#")[0] for target in targets if "://" not in target and not target.startswith("#")]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_every_link_leads_to_a_file(document: Path) -> None:
    missing = [target for target in links(document) if not (document.parent / target).exists()]
    assert not missing


def test_the_front_page_links_every_document() -> None:
    unlinked = {f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")} - set(links(ROOT / "README.md"))
    assert not unlinked
