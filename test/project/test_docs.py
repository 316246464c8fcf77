"""The site that `make docs` makes: complete, and itself alone."""

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlparse

import pytest
from typer.main import get_command

import multi_robot_slam
from msg_defs import limits, topics
from multi_robot_slam.cli import main
from multi_robot_slam.config import Config

ROOT = Path(__file__).parents[2]
for module in ("sphinx", "furo", "myst_parser", "latex2mathml", "ziamath"):
    pytest.importorskip(module, reason="no Sphinx: pip install 'multi_robot_slam[docs]'")
pytest.importorskip("rclpy", reason="no ROS: the nodes' parameters are read from the nodes")

FETCHED = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "srcset"}
FETCHED |= {"video": "src", "audio": "src", "object": "data", "embed": "src"}
"""What a browser loads by itself to show a page."""


class Page(HTMLParser):
    """What a page loads, where it links to, its anchors and the names it has as code."""

    def __init__(self, text):
        super().__init__()
        self.loads, self.links, self.anchors = [], [], set()
        self.feed(text)
        self.code = {
            re.sub("<[^>]*>", "", code).replace("&lt;", "<").replace("&gt;", ">")
            for code in re.findall(r"<code[^>]*>(.*?)</code>", text, re.DOTALL)
        }

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.anchors.add(given.get("id"))
        if FETCHED.get(tag) in given:
            self.loads.append(given[FETCHED[tag]])
        if tag == "a" and "href" in given:
            self.links.append(given["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site; a warning is an error."""
    folder = tmp_path_factory.mktemp("docs")
    options = ["-q", "-W", "--keep-going", "-d", str(folder / "doctrees")]
    command = [sys.executable, "-m", "sphinx", *options, str(ROOT / "docs"), str(folder / "site")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "site"


@pytest.fixture(scope="module")
def pages(site):
    return {path: Page(path.read_text()) for path in site.rglob("*.html")}


def test_every_document_is_a_page(site, pages):
    documents = [path.relative_to(ROOT / "docs") for path in (ROOT / "docs").rglob("*.md")]
    assert {site / path.with_suffix(".html") for path in documents} <= set(pages)


def test_no_page_loads_anything_from_elsewhere(site, pages):
    loaded = [(path, address) for path, page in pages.items() for address in page.loads]
    for sheet in site.rglob("*.css"):
        for address in re.findall(r"(?:url\(|@import)\s*[\"']?([^\"')\s]+)", sheet.read_text()):
            loaded.append((sheet, address))
    addresses = [(path, urlparse(address)) for path, address in loaded]
    outside = [(p, a.geturl()) for p, a in addresses if a.netloc or a.scheme not in ("", "data")]
    assert outside == []
    inside = [(p, unquote(a.path)) for p, a in addresses if not a.scheme and a.path]
    assert len(inside) > 5 * len(pages)
    assert [(p, name) for p, name in inside if not (p.parent / name).exists()] == []


def test_every_link_within_leads_somewhere(pages):
    lost = []
    for path, page in pages.items():
        for link in map(urlparse, page.links):
            target = (path.parent / unquote(link.path)).resolve() if link.path else path
            if link.scheme or link.netloc:
                continue
            is_lost = target in pages and link.fragment not in {"", *pages[target].anchors}
            if is_lost or not target.exists():
                lost.append((path.name, link.geturl()))
    assert lost == []


def test_every_equation_is_drawn(site):
    text = (ROOT / "docs" / "design.md").read_text()
    made = (site / "design.html").read_text()
    numbers = re.findall(r"\\tag\{(.*?)\}", text)
    assert len(numbers) > 50
    assert re.findall(r"</math><span>\((.*?)\)</span>", made) == numbers
    formulas = re.findall(r"<math.*?</math>", made, re.DOTALL)
    assert [formula for formula in formulas if "\\" in formula] == []
    assert not re.search(r"\\tag|\$\$", made)


def test_every_parameter_topic_command_and_name_is_there(site, pages):
    parameters = {code.partition(" ")[0] for code in pages[site / "parameters.html"].code}
    assert {leaf.name for leaf in limits.leaves(Config)} <= parameters
    assert {"autostart", "map_out", "rate", "speed", "only"} <= parameters
    told = {topic.name for topic in topics.fusion_outputs(["<robot>"])}
    assert told <= pages[site / "topics.html"].code
    assert set(commands(get_command(main.app))) <= pages[site / "commands.html"].code
    exported = {f"multi_robot_slam.{name}" for name in multi_robot_slam.__all__}
    assert exported <= pages[site / "api.html"].anchors


def commands(group, prefix="multi_robot_slam"):
    """The names of all commands that are not hidden, with those they are in."""
    for name, command in group.commands.items():
        if not command.hidden:
            yield f"{prefix} {name}"
        if hasattr(command, "commands"):
            yield from commands(command, f"{prefix} {name}")
