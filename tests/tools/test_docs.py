# SPDX-License-Identifier: Apache-2.0
"""Names and links in README and the documentation exist, figures are those of docs/data, extras are named."""

import re
import subprocess
import sys

import named
import pytest
from pages import ROOT

EXTRAS = {
    "cluster": r"--jobs ray",
    "export": r"warpmpc export\b|--(export|mcap|hdf5)\b",
    "gymnasium": r"BatchVectorEnv|examples/ppo\.py",
    "live": r"warpmpc live\b",
    "onnx": r"\bpolicy ?= ?['\"]|examples/imitate\.py",
    "plot": r"warpmpc plot\b",
    "record": r"--record\b|RecordingSwitch",
    "ros2": r"--robot ros2|--ros2\b",
    "transport": r"--robot zmq|--zmq\b",
    "tune": r"warpmpc tune\b",
    "usd": r"\bUSD \(|\.usda?\b",
}
"""What needs an extra."""


@pytest.mark.parametrize("page", named.pages())
def test_every_file_name_option_and_key_that_a_page_names_exists(page):
    assert named.missing(page) == []


@pytest.mark.parametrize(
    "planted",
    [
        "`tools/nope.py`",
        "`kernels/planner/nope.py`",
        "`tests/nope/`",
        "`omni_push_bax.toml`",
        "`warpmpc.Controler`",
        "`warpmpc.planner.stepp`",
        "`PlanGraf`",
        "`JudgingEngine.evaluat`",
        "`no_such_function(state)`",
        "`self_colision`",
        "`--enginee`",
        "`warpmpc fly omni_push_box`",
        "`warpmpc run omni_push_box --epsiodes 3`",
        "`[[robt]]`",
        "`planner.smaples`",
        "`robot.drive.dampening = 3.0`",
        "```sh\npython tools/nope.py\n```",
        "```sh\npython tools/gate.py --nope\n```",
        "```toml\n[planner]\nsmaples = 3\n```",
        '```toml\n[[cost]]\nterm = "distance"\nbetwen = ["a", "b"]\n```',
    ],
)
def test_a_name_that_does_not_exist_is_found(planted, tmp_path, monkeypatch):
    page = ROOT / "docs" / "planted.md"
    text = f"# A page\n\n{planted}\n"
    real = type(page).read_text
    monkeypatch.setattr(type(page), "read_text", lambda self, **how: text if self == page else real(self, **how))
    assert len(named.missing("docs/planted.md")) == 1


@pytest.mark.parametrize("page", [*named.pages(), "CHANGELOG.md"])
def test_every_link_of_a_checkout_leads_to_a_file(page):
    text = re.sub(r"^\s*```.*?^\s*```$", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    links = [link.partition("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in link]
    files = [(ROOT / page).parent.joinpath(link).resolve().relative_to(ROOT) for link in links if link]
    assert [str(file) for file in files if str(file) not in named.repository()] == []


@pytest.mark.parametrize("page", [page for page in named.pages() if page != "docs/gallery.md"])
def test_a_page_names_the_extras_that_it_needs(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    needed = [extra for extra, what in EXTRAS.items() if re.search(what, text)]
    assert [extra for extra in needed if not re.search(rf"\[[\w,]*\b{extra}\b[\w,]*\]", text)] == []


def test_pages_have_the_tables_that_their_figures_make():
    command = [sys.executable, "tools/pages/figures.py", "--check"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr, done.returncode) == ("", "", 0)


def test_every_picture_is_shown_and_every_file_of_figures_has_a_table():
    text = "\n".join((ROOT / page).read_text(encoding="utf-8") for page in named.pages())
    files = [ROOT / path for path in named.repository() if path.startswith("docs/")]
    pictures = [path.name for path in files if path.suffix in (".png", ".webp", ".jpg", ".svg")]
    assert [name for name in pictures if name not in text] == []
    figures = [path.stem for path in files if path.parent.name == "data"]
    assert [name for name in figures if f"<!-- data: {name} -->" not in text] == []


def test_the_pages_stay_small():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150
    by_tools = ("docs/reference/", "docs/gallery.md", "docs/robots.md")
    by_hand = [page for page in named.pages() if not page.startswith(by_tools)]
    words = {page: len((ROOT / page).read_text(encoding="utf-8").split()) for page in by_hand}
    assert sum(words.values()) <= 14_000, words
