"""Every code block of the documentation runs, page by page, in a folder with the examples; one of these does too."""

import importlib.util
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from madoc import robots
from madoc.commands.main import main
from madoc.parameters import FIELDS
from madoc.robots.document import yaml_text
from madoc.suites.planning import plan_of

read_yaml = YAML(typ="safe").load
ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PENDULUM = Path(os.environ.get("MADOC_PENDULUM", ROOT.parent / "shared" / "data" / "dfki_simple_pendulum"))
SERVO = Path(os.environ.get("MADOC_XL330", ROOT.parent / "shared" / "data" / "xl330"))
ARM = Path(os.environ.get("MADOC_SO101", ROOT.parent / "shared" / "data" / "so101"))
SLOW = {
    "tutorial.md",
    "real-arm.md",
    "real-pendulum.md",
    "real-servo.md",
    "how-to/cluster.md",
    "how-to/compare-methods.md",
    "how-to/export.md",
    "how-to/many-robots.md",
    "how-to/own-policy.md",
    "how-to/partial-observation.md",
    "how-to/resume.md",
}

BLOCK = re.compile(r"^```(\S*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
EXIT_CODE = re.compile(r"# exit code (\d+)$")
"""A comment of a command that does not end with 0."""
PAGES = [str(page.relative_to(DOCS)) for page in sorted(DOCS.rglob("*.md")) if "```" in page.read_text()]


@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=[pytest.mark.slow] if page in SLOW else []) for page in PAGES]
)
def test_the_blocks_run(page, tmp_path, monkeypatch):
    text = (DOCS / page).read_text()
    if "$PENDULUM" in text and not PENDULUM.is_dir():
        pytest.skip("the logs of the DFKI pendulum are not here; name their folder in MADOC_PENDULUM")
    monkeypatch.chdir(tmp_path)
    if "$SO101" in text and not ARM.is_dir():
        pytest.skip("the logs of the SO-101 arm are not here; name their folder in MADOC_SO101")
    monkeypatch.setenv("PENDULUM", str(PENDULUM))
    monkeypatch.setenv("SO101", str(ARM))
    if "$XL330" in text and not SERVO.is_dir():
        pytest.skip("the logs of the XL330 servo are not here; name their folder in MADOC_XL330")
    monkeypatch.setenv("XL330", str(SERVO))
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    names = {}
    for language, block in BLOCK.findall(text):
        RUN[language](block, names)


def run_shell(block, _):
    for line in block.splitlines():
        words = shlex.split(os.path.expandvars(line))
        if words[0] == "madoc":
            told = EXIT_CODE.search(line)
            given = [*shlex.split(os.path.expandvars(line), comments=True)[1:], "--quiet"]
            assert main(given) == (int(told[1]) if told else 0), line
        elif words[0] == "python":
            run_script(words[1:])
        else:
            subprocess.run(["bash", "-euc", line], check=True, stdout=subprocess.DEVNULL)


def run_script(words):
    before, sys.argv = sys.argv, words
    try:
        runpy.run_path(words[0], run_name="__main__")
    finally:
        sys.argv = before


def run_python(block, names):
    exec(compile(block, "block", "exec"), names)


def load_yaml(block, _):
    """A suite file is left for the next command and planned, unless its logs are recorded only then."""
    if "cells" not in read_yaml(block):
        return load_spec(block)
    Path("suite.yaml").write_text(block)
    if "record:" in block:
        plan_of(Path("suite.yaml"))
    return None


def load_spec(block):
    """A part of a spec takes that part's place in the pendulum's or the arm's.

    The arm's motors make way for actuators of the block's own.
    """
    if "hinge" in block:
        whole = read_yaml(Path("examples/pendulum/swing_up.yaml").read_text()) | read_yaml(block)
        Path("part.yaml").write_text(yaml_text(whole | {"model": "examples/pendulum/pendulum.xml"}))
        robots.load("part.yaml")
        return
    whole = read_yaml(Path("examples/arm/arm.yaml").read_text()) | read_yaml(block)
    for channel, default in zip(whole["signals"], ("shoulder", "elbow"), strict=False):
        whole.setdefault("log", {}).setdefault("columns", {}).setdefault(channel["name"], default)
    model = Path("examples/arm/arm.xml").read_text().splitlines()
    driven = [channel["joint"] for channel in whole["actions"] if "joint" in channel]
    Path("part.xml").write_text(
        "\n".join(
            line for line in model if not any("<motor" in line and f'joint="{joint}"' in line for joint in driven)
        )
    )
    whole["model"] = "part.xml"
    Path("part.yaml").write_text(yaml_text(whole))
    robots.load("part.yaml")


RUN = {
    "shell": run_shell,
    "python": run_python,
    "yaml": load_yaml,
    "py": lambda block, _: compile(block, "docs", "exec"),
}
"""What is done with a block of each language; `py` needs packages that are not installed here, and is compiled."""


def test_every_field_of_a_parameter_is_explained():
    page = (DOCS / "how-to" / "own-robot.md").read_text()
    first_columns = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `")]
    assert set(FIELDS) <= {name for column in first_columns for name in re.findall("`(.*?)`", column)}


def test_measured_tables_are_there():
    hooks = load_hooks()
    page = (DOCS / "concepts" / "which-method.md").read_text()
    assert "| least-squares |" in hooks.on_page_markdown(page)
    with pytest.raises(KeyError):
        hooks.measured("No such heading")


def test_equations_become_mathml():
    told = load_hooks().on_page_content(r'<p><span class="arithmatex">\(a &lt; b\)</span></p>')
    assert told.startswith("<p><math")
    assert "<mi>a</mi>" in told
    assert "arithmatex" not in told


def test_no_equation_keeps_a_command_that_was_not_understood():
    hooks = load_hooks()
    equations = re.findall(r"\$\$(.*?)\$\$", (DOCS / "concepts" / "equations.md").read_text(), re.DOTALL)
    assert equations
    for equation in equations:
        assert "\\" not in hooks.on_page_content(rf'<div class="arithmatex">\[{equation}\]</div>'), equation


def load_hooks():
    pytest.importorskip("latex2mathml", reason="the extra docs is not installed")
    spec = importlib.util.spec_from_file_location("hooks", DOCS / "hooks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_the_site_is_built_and_fetches_nothing(tmp_path):
    pytest.importorskip("mkdocs", reason="the extra docs is not installed")
    site = tmp_path / "site"
    subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", site],
        cwd=ROOT,
        check=True,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
    )
    pages = list(site.rglob("*.html"))
    assert len(pages) >= len(list(DOCS.rglob("*.md")))
    fetched = re.compile(
        r"<(?:script|img|iframe)[^>]*src=\"https?:|<link[^>]*rel=\"(?:stylesheet|preconnect)\"[^>]*https?:"
    )
    assert not [page.name for page in pages if fetched.search(page.read_text())]
    assert "<math" in (site / "concepts" / "equations.html").read_text()


def test_the_first_example_finds_its_spring():
    command = [sys.executable, ROOT / "examples" / "01_spring.py"]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=280, check=True)
    error = re.search(r"([\d.]+) % of range", ran.stdout)
    assert error, ran.stdout
    assert float(error[1]) < 5.0
