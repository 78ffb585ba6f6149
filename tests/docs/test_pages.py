# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the commands and the Python of the tutorials, page by page, each in an empty folder.

They run as they stand, except for their length: campaigns have two aircraft, sweeps one value,
margins two samples, trades one phase margin, and flights two seconds, or three in Python. The
notebooks run, too. All run in the process of the tests, which imports the stack once.
"""

import json
import os
import re
import runpy
import shlex
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import pytest
from tests.conftest import REPOSITORY, invoke
from tools import parameters

from flight_analysis.closed_loop.simulate import simulate
from flight_cli import gains_tables
from flight_design.gains.trade import trade
from flight_design.identification import manoeuvre
from rise_di import own_airframe

PAGES = [
    REPOSITORY / "docs" / "get-started.md",
    REPOSITORY / "docs" / "reference" / "python.md",
    *sorted((REPOSITORY / "docs" / "tutorials").glob("*.md")),
]
NOTEBOOKS = sorted((REPOSITORY / "examples" / "notebooks").glob("*.ipynb"))
BLOCK = re.compile(
    r"(?:<!-- (?P<reason>not run by the tests of the pages: [^\n]+) "
    r"-->\n)?```(?P<kind>\w*)\n(?P<text>.*?)```",
    re.DOTALL,
)
EXECUTED = {"sh", "python"}
BY_HAND = "by hand, "
"""In a reason: no program runs the block. benchmarks/pages.py runs the others as they stand."""

TIMEOUT = 600.0  # s, of a block: the longest takes about 30 s on an idle host
pytestmark = pytest.mark.timeout(2.0 * TIMEOUT)


def blocks(page: Path) -> list[tuple[str, str, str]]:
    """Return kind, text and the reason for not running it, for each block of a page."""
    return [
        (block["kind"], block["text"], block["reason"] or "")
        for block in BLOCK.finditer(page.read_text())
    ]


def environment() -> dict[str, str]:
    """Return the environment of a reader who has `rise-di` on the path and no screen."""
    return os.environ | {
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "MPLBACKEND": "agg",
    }


def run(command: list[str], folder: Path) -> None:
    process = subprocess.run(
        command,
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
        check=False,
    )
    assert process.returncode == 0, f"{' '.join(command)}\n{process.stdout}\n{process.stderr}"


RISE_DI = """rise-di() {
    local status size
    echo "${@@Q}" >&3
    read -r status size <&4
    head --bytes "$size" <&4
    return "$status"
}
"""
"""A function of bash: asks the process of the tests for a command, and answers as it does."""


def run_shell(text: str) -> None:
    """Run a block with bash, and each `rise-di` in it in this process."""
    (asked, asks), (answered, answers) = os.pipe(), os.pipe()
    script = f"exec 3>&{asks} 4<&{answered}\n{RISE_DI}{text}"
    command = ["bash", "-euo", "pipefail", "-c", script]
    with (
        tempfile.TemporaryFile("w+") as output,
        os.fdopen(asked) as questions,
        os.fdopen(answers, "wb", buffering=0) as reply,
        subprocess.Popen(
            command,
            env=environment(),
            pass_fds=(asks, answered),
            stdout=output,
            stderr=output,
        ) as process,
    ):
        os.close(asks)
        os.close(answered)
        for words in map(shlex.split, questions):
            done = invoke(*words)
            said = f"{done.output}{done.exception or ''}\n".encode()
            reply.write(b"%d %d\n" % (done.exit_code, len(said)) + said)
        process.wait(TIMEOUT)
        output.seek(0)
        assert process.returncode == 0, f"{text}\n{output.read()}"


def run_python(text: str) -> None:
    """Run a program of Python in this process."""
    Path("page.py").write_text(text)
    runpy.run_path("page.py", run_name="__main__")


SHORTER = (
    (r"(--aircraft|--samples) \d+", r"\1 2"),
    (r"--duration \d+", "--duration 2"),
    (r"(--sweep \S+=)[\d.,]+", r"\g<1>2"),
    (r"(rise-di fly \S+ --in-process)(?! --duration)", r"\1 --duration 2"),
    (r"duration=\d+\.0", "duration=3.0"),
    (r"rise_di\.simulate\((\w+)\)", r'rise_di.simulate(\1.vary(flight={"duration": 3.0}))'),
    (r"range\(6\)", "range(2)"),  # aircraft of a notebook
)


@pytest.fixture(autouse=True)
def _shorter_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten what no option of a command does."""
    for module in (manoeuvre, own_airframe):
        monkeypatch.setattr(
            module, "simulate", lambda each: simulate(each.vary(flight={"duration": 2.0}))
        )
    monkeypatch.setattr(gains_tables, "trade", partial(trade, phase_margins=(45.0,)))
    monkeypatch.setattr(own_airframe, "SIZES", (0.125,))
    monkeypatch.setattr(own_airframe, "SAMPLES", 0)


def shortened(text: str) -> str:
    """Return the commands or the Python of a block with fewer aircraft, samples and seconds."""
    for pattern, replacement in SHORTER:
        text = re.sub(pattern, replacement, text)
    return text


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_blocks_of_page_run_in_order(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(REPOSITORY / "examples")
    executed: list[str] = []  # the Python blocks of a page are one session
    for kind, text, reason in blocks(page):
        if kind == "sh" and not reason:
            run_shell(shortened(text))
        elif kind == "python" and not reason:
            executed.append(shortened(text))
    run_python("\n".join(executed))


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_each_block_of_page_is_run_or_says_why_not(page: Path) -> None:
    assert blocks(page)
    assert all(kind in EXECUTED for kind, _, _ in blocks(page))


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_and_stored_without_output(
    notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cells = json.loads(notebook.read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert code
    assert not any(cell.get("outputs") for cell in cells)
    monkeypatch.chdir(tmp_path)
    run_python(shortened("\n".join(code)))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the site, built without a warning."""
    folder = tmp_path_factory.mktemp("site")
    options = ["--strict", "--quiet", "-f", str(REPOSITORY / "mkdocs.yml"), "-d", str(folder)]
    run([sys.executable, "-m", "mkdocs", "build", *options], folder)
    return folder


def test_the_site_has_every_page(site: Path) -> None:
    pages = {
        path.relative_to(REPOSITORY / "docs").with_suffix(".html")
        for path in (REPOSITORY / "docs").rglob("*.md")
    }
    assert all((site / page).is_file() for page in pages)


def test_a_formula_is_mathml_on_the_site(site: Path) -> None:
    code = re.compile(r"<(pre|code|script|style)\b.*?</\1>", re.DOTALL)
    pages = {path.name: code.sub("", path.read_text()) for path in site.rglob("*.html")}
    theory = (REPOSITORY / "docs" / "theory.md").read_text()
    assert pages["theory.html"].count("<math") == theory.replace("$$", "$").count("$") / 2
    assert [name for name, page in pages.items() if re.search(r"\\[(\[]|\$", page)] == []


def test_the_site_loads_nothing_from_another_host(site: Path) -> None:
    pages = {path.name: path.read_text() for path in site.rglob("*.html")}
    loads = re.compile(r"""<link [^>]*\bhref="?(?:https?:)?//|\bsrc(?:set)?="?(?:https?:)?//""")
    assert [name for name, page in pages.items() if loads.search(page)] == []
    # The theme would load the library of such a diagram from a host; without the library the
    # diagram is code.
    assert [
        page.name
        for page in (REPOSITORY / "docs").rglob("*.md")
        if "```mermaid" in page.read_text()
    ] == []


def test_reference_of_parameters_is_that_of_classes() -> None:
    assert parameters.PAGE.read_text() == parameters.page(), (
        "python -m tools.parameters writes it again"
    )
