"""Every command and every Python block of the pages, as a reader would type them.

Blocks `sh` and `python` of a page run in order, in an empty folder of the page's own. Of blocks
`sh long`, and of commands within the text, only the command's name and options are checked.
"""

import re
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import typer
from recorded import DATA

from stario.fusion.commands.cli import app, main
from stario.network.model import load_model

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("examples", "fusion", "network", "sequences")
PAGES = [ROOT / "README.md", *sorted(page for f in FOLDERS for page in (ROOT / f).rglob("*.md"))]
GUIDES = [ROOT / "README.md", *sorted((ROOT / "examples/guides").glob("*.md"))]
BLOCK = re.compile(r"^```(\w+)( long)?\n(.*?)^```", re.M | re.S)
INLINE = re.compile(r"`(stario [^`]+)`|^ {4,}(?:\.venv/bin/)?(stario .+?)(?: # .*)?$", re.M)


def page_name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def blocks(page: Path, language: str, long: bool) -> list[str]:
    found = BLOCK.findall(page.read_text())
    return [text for kind, marked, text in found if kind == language and bool(marked) == long]


def lines(text: str) -> list[str]:
    """Return a block's commands, with continued lines joined."""
    return [line for line in text.replace("\\\n", " ").splitlines() if line.strip()]


def check_known(words: list[str]) -> None:
    """Check that subcommands and options of a `stario` command exist; its files need not."""
    command, rest = typer.main.get_command(app), words[1:]
    while rest and hasattr(command, "commands") and not rest[0].startswith("-"):
        assert rest[0] in command.commands, " ".join(words)
        command, rest = command.commands[rest[0]], rest[1:]
    known = {name for each in command.params for name in (*each.opts, *each.secondary_opts)}
    for word in rest:
        if word.startswith("--"):
            assert word.partition("=")[0] in known, f"{word} in {' '.join(words)}"


def stario_commands(text: str) -> list[list[str]]:
    """Return the `stario` commands of a text, each as words, without what precedes them."""
    split = [shlex.split(line, comments=True) for line in lines(text)]
    found = []
    for words in split:
        at = next((k for k, word in enumerate(words) if Path(word).name == "stario"), None)
        if at is not None:
            found.append(words[at:])
    return found


@pytest.fixture(scope="module", autouse=True)
def _prepared_once():
    """Load the packaged weights and build the command once, and leave figures blank."""
    with pytest.MonkeyPatch.context() as patch:
        # Drawing is slow.
        patch.setattr("stario.fusion.evaluation.results._figures", lambda found: {})
        for module in ("fusion.evaluation.results", "sequences.drawing.figures"):
            patch.setattr(f"stario.{module}.save_figure", lambda figure, path: path.touch())
        patch.setattr("stario.network.model.load_model", cache(load_model))
        patch.setattr("typer.main.get_command", cache(typer.main.get_command))
        yield


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_commands_in_a_page_exist_with_their_options(page):
    text = page.read_text()
    for block in (*blocks(page, "sh", True), *blocks(page, "sh", False)):
        for words in stario_commands(block):
            check_known(words)
    for match in INLINE.findall(BLOCK.sub("", text)):
        command = re.sub(r"\s+", " ", "".join(match)).replace("...", "").replace("'", "")
        if all(not re.search(r"[{}<>|]", word) for word in command.split()):
            check_known(command.split())


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_links_of_a_page_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#\s]*)(?:#[^)]*)?\)", page.read_text()):
        if target and "://" not in target:
            assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", GUIDES, ids=page_name)
def test_a_guide_is_short(page):
    assert len(page.read_text().splitlines()) <= (120 if page.name == "README.md" else 150)


def shorter(line: str) -> str:
    """Return the command for a walk of fewer samples, which take most of these tests' time."""
    if not line.startswith("stario simulate"):
        return line
    line = line.partition("#")[0] + " --rate 50"
    return line if "--floors" in line else re.sub(r"--seconds \d+", "--seconds 15", line)


def run_line(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    words = shlex.split(shorter(line), comments=True)
    if words[0] == "python":
        assert (ROOT / words[1]).is_file()  # test_examples runs it
    elif words[0] != "stario":
        subprocess.run(["bash", "-ec", line], check=True, capture_output=True)
    else:
        there = [word.replace("$STARIO_DATA", str(DATA)) for word in words]
        monkeypatch.setattr(sys, "argv", there)
        with pytest.raises(SystemExit) as leaving:
            main()
        assert not leaving.value.code, line


FOLLOWED = [
    # These two run the most commands; the others' options are checked above as well.
    pytest.param(page, marks=pytest.mark.slow if page.stem in ("maps", "recordings") else ())
    for page in GUIDES
]


@pytest.mark.parametrize("page", FOLLOWED, ids=page_name)
def test_a_reader_can_follow_a_guide(page, monkeypatch, tmp_path, tmp_path_factory):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("STARIO_CACHE", str(tmp_path_factory.mktemp("cache")))
    names = {"__name__": page.stem}
    for language, long, text in BLOCK.findall(page.read_text()):
        if language == "python":
            exec(compile(text, page_name(page), "exec"), names)
        elif language == "sh" and not long:
            for line in lines(text):
                if "$STARIO_DATA" not in line:
                    run_line(line, monkeypatch)


ON_DATA = [
    pytest.param(line, id=f"{page_name(page)}: {line}")
    for page in GUIDES
    for text in blocks(page, "sh", False)
    for line in lines(text)
    if "$STARIO_DATA" in line
]


@pytest.mark.slow
@pytest.mark.parametrize("line", ON_DATA)
def test_commands_on_recordings_run(line, monkeypatch, tmp_path):
    if not DATA.is_dir():
        pytest.skip(f"STARIO_DATA names no folder of recordings, needed by: {line}")
    monkeypatch.chdir(tmp_path)
    run_line(line, monkeypatch)
