"""The site builds without a warning from the Markdown of the repository; in the extended run only."""

import json
import re
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from cnpgen.addons.manual.name_page import name_page
from cnpgen.cli.docs_command import list_pages, page_url
from cnpgen.machine import versions
from tests.conftest import HANGING

ROOT = Path(__file__).parents[2]
PARTS = ("cnpgen", "docs", "datasets", "pipelines", "problems")


def copy_of_the_repository(folder: Path) -> Path:
    """Copy the sources of the site, because a build writes pages of the API beside the others."""
    for name in PARTS:
        shutil.copytree(
            ROOT / name,
            folder / name,
            ignore=shutil.ignore_patterns("__pycache__", "api"),
        )
    for page in ROOT.glob("*.md"):
        shutil.copy(page, folder)

    return folder


def build(
    source: Path, out: Path, *, builder: str = "html"
) -> subprocess.CompletedProcess[str]:
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-W",
        "--keep-going",
        "-b",
        builder,
        "-c",
        str(source / "docs"),
        str(source),
        str(out),
    ]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=HANGING, check=False
    )


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site."""
    for library in ("sphinx", "myst_parser", "furo"):
        pytest.importorskip(library)
    source, out = (
        copy_of_the_repository(tmp_path_factory.mktemp("source")),
        tmp_path_factory.mktemp("site"),
    )
    done = build(source, out)
    assert done.returncode == 0, done.stderr
    return out


@pytest.mark.extended
def test_every_page_is_on_the_site_at_its_address_and_in_the_navigation(
    site: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(versions, "DOCUMENTATION_URL", "https://docs.example.org/")
    front = (site / "docs" / "index.html").read_text(encoding="utf-8")
    for name, page in list_pages().items():
        address = str(page_url(page)).removeprefix("https://docs.example.org/")
        assert (site / address).is_file(), name
        assert name == "index" or f'href="{address.removeprefix("docs/")}"' in front, (
            name
        )
    assert "docs/index.html" in (site / "index.html").read_text(encoding="utf-8")


@pytest.mark.extended
def test_every_tutorial_links_to_its_notebook(site: Path) -> None:
    tutorials = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
    assert len(tutorials) >= 5
    for page in tutorials:
        text = (site / "docs" / "tutorials" / f"{page.stem}.html").read_text(
            encoding="utf-8"
        )
        assert f'href="../../notebooks/{page.stem}.ipynb"' in text
        assert (site / "notebooks" / f"{page.stem}.ipynb").is_file()


@pytest.mark.extended
def test_every_public_name_has_a_page_with_its_signature(site: Path) -> None:
    names = re.findall(
        r"^\| `(\w+)` \|",
        name_page(),
        re.M,
    )
    pages = {
        path.stem.rpartition(".")[2]: path
        for path in (site / "docs" / "reference" / "api").glob("*.html")
    }
    assert set(names) == set(pages)
    assert 'id="cnpgen.make_dataset"' in pages["make_dataset"].read_text(
        encoding="utf-8"
    )
    assert 'id="cnpgen.interop.torch.TensorLoss"' in pages["TensorLoss"].read_text(
        encoding="utf-8"
    )
    assert "certify" in pages["make_dataset"].read_text(encoding="utf-8")


@pytest.mark.extended
def test_the_search_finds_words_of_pages_and_names(site: Path) -> None:
    index = (site / "searchindex.js").read_text(encoding="utf-8")
    assert "docs/concepts/splines" in index
    assert "make_dataset" in index
    assert (site / "search.html").is_file()


@pytest.mark.extended
@pytest.mark.parametrize(
    "error", ["[gone](gone.md)", "[gone](splines.md#no-such-heading)"]
)
def test_a_broken_link_fails_the_build(error: str, tmp_path: Path) -> None:
    for library in ("sphinx", "myst_parser", "furo"):
        pytest.importorskip(library)
    source = copy_of_the_repository(tmp_path / "source")
    with (source / "docs" / "concepts" / "scenes.md").open(
        "a", encoding="utf-8"
    ) as page:
        page.write(f"\n{error}\n")
    done = build(
        source, tmp_path / "site", builder="dummy"
    )  # resolves links and writes nothing
    assert done.returncode != 0
    assert "scenes.md" in done.stderr


@pytest.mark.extended
def test_the_check_of_external_links_finds_a_broken_one(tmp_path: Path) -> None:
    for library in ("sphinx", "myst_parser", "furo"):
        pytest.importorskip(library)
    (tmp_path / "pages").mkdir()
    (tmp_path / "pages" / "there.html").write_text("<p>here</p>", encoding="utf-8")
    source = copy_of_the_repository(tmp_path / "source")
    with serve(tmp_path / "pages") as address:
        links = [
            f"[a]({address}/there.html)",
            f"[b]({address}/gone.html)",
            "[c](https://cnpgen.example.org/gone)",
        ]
        with (source / "docs" / "concepts" / "scenes.md").open(
            "a", encoding="utf-8"
        ) as page:
            page.write("\n" + " ".join(links) + "\n")
        done = build(source, tmp_path / "links", builder="linkcheck")
    lines = [
        json.loads(line)
        for line in (tmp_path / "links" / "output.json")
        .read_text(encoding="utf-8")
        .splitlines()
    ]
    status = {line["uri"]: line["status"] for line in lines}
    assert status[f"{address}/there.html"] == "working"
    assert status[f"{address}/gone.html"] == "broken"
    assert status["https://cnpgen.example.org/gone"] == "ignored"
    assert done.returncode != 0
    outside = {
        uri for uri in status if "127.0.0.1" not in uri and "example.org" not in uri
    }
    assert len(outside) > 5
    if has_network():
        assert {uri for uri in outside if status[uri] == "broken"} == set()


def has_network() -> bool:
    """Return whether addresses outside of this machine can be reached."""
    try:
        socket.create_connection(("github.com", 443), timeout=5).close()
    except OSError:
        return False
    return True


CHROMIUM = (
    shutil.which("chromium")
    or shutil.which("chromium-browser")
    or shutil.which("google-chrome")
)
needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium on this machine"
)
MEASURE = """<!DOCTYPE html><title>measure</title><body><pre id="found"></pre><script>
const measure = async (address, width) => {
  const frame = document.createElement("iframe");
  Object.assign(frame, {width, height: 900, src: address});
  const loaded = new Promise((done) => { frame.onload = done; });
  document.body.append(frame);
  await loaded;
  const root = frame.contentDocument.documentElement, article = frame.contentDocument.querySelector("article");
  const found = {address, width, overflow: root.scrollWidth - root.clientWidth, text: article.innerText.length,
                 size: parseFloat(frame.contentWindow.getComputedStyle(article).fontSize),
                 pictures: [...root.querySelectorAll("article img")].filter((image) => !image.alt).length};
  frame.remove();
  return found;
};
(async () => {
  const all = [];
  for (const address of ADDRESSES) { for (const width of [1280, 400]) { all.push(await measure(address, width)); } }
  document.getElementById("found").textContent = JSON.stringify(all);
})();
</script></body>"""


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Do not log requests."""


@contextmanager
def serve(folder: Path) -> Iterator[str]:
    """Serve a folder; yield its address."""
    with ThreadingHTTPServer(
        ("127.0.0.1", 0), partial(_Quiet, directory=str(folder))
    ) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.fixture(scope="module")
def address(site: Path) -> Iterator[str]:
    """Address at which the site is served."""
    with serve(site) as url:
        yield url


def chromium(
    profile: Path, url: str, *options: str, budget: int = 8_000
) -> subprocess.CompletedProcess[str]:
    """Open a page in a browser without a screen."""
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
    ]
    flags += [
        "--no-first-run",
        "--disable-background-networking",
        "--disable-sync",
        f"--user-data-dir={profile}",
    ]
    flags += ["--enable-logging=stderr", "--v=0", f"--virtual-time-budget={budget}"]
    command = [str(CHROMIUM), *flags, *options, url]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=HANGING, check=True
    )


def errors(log: str) -> list[str]:
    """Return the messages of a page's console, without the driver's remarks on speed."""
    return [
        line
        for line in log.splitlines()
        if "CONSOLE" in line and "GL Driver Message" not in line
    ]


@pytest.mark.extended
def test_the_gallery_is_part_of_the_site(site: Path) -> None:
    pytest.importorskip("meshcat")
    text = (site / "docs" / "how-to" / "gallery.html").read_text(encoding="utf-8")
    frames = re.findall(r'<iframe src="../../gallery/(\w+).html"', text)
    assert {"hit", "transport", "clutter", "comparison"} <= set(frames)
    assert {path.stem for path in (site / "gallery").glob("*.html")} == set(frames)
    for name in re.findall(r'<img src="../../gallery/([\w-]+).png"', text):
        assert (site / "gallery" / f"{name}.png").stat().st_size > 10_000


@pytest.mark.extended
def test_pages_of_planners_are_part_of_the_site_and_linked(site: Path) -> None:
    pytest.importorskip("ziglang")
    text = (site / "docs" / "how-to" / "deploy.html").read_text(encoding="utf-8")
    linked = re.findall(r'href="../../interactive/(\w+).html"', text)
    pages = [path.stem for path in (site / "interactive").glob("*.html")]
    assert sorted(linked) == sorted(pages) == ["puck", "transport"]


@pytest.mark.extended
@needs_chromium
def test_the_pages_of_the_gallery_run_without_an_error_and_draw_their_scene(
    site: Path, address: str, tmp_path: Path
) -> None:
    image = pytest.importorskip("matplotlib.image")
    pages = sorted((site / "gallery").glob("*.html"))
    assert len(pages) >= 4
    for page in pages:
        picture, url = (
            tmp_path / f"{page.stem}.png",
            f"{address}/gallery/{page.name}#time=100",
        )
        done = chromium(
            tmp_path / "browser",
            url,
            f"--screenshot={picture}",
            "--window-size=1200,700",
        )
        assert errors(done.stderr) == [], page.name
        scene = image.imread(picture)[60:560, 20:760, :3]
        assert (scene.max(axis=2) < 0.85).mean() > 0.03, (
            page.name
        )  # bodies in front of the bright background
        assert np.ptp(scene, axis=2).max() > 0.2, (
            page.name
        )  # colored frames, objects or obstacles
        text = chromium(tmp_path / "browser", url, "--dump-dom").stdout
        assert 'data-ready="yes"' in text
        if page.stem != "comparison":  # the plan of the network may be rejected
            assert re.search(r'<span id="badge"[^>]*>valid<', text), page.name


@pytest.mark.extended
@needs_chromium
def test_pages_are_legible_at_1280_and_400_pixels(
    site: Path, address: str, tmp_path: Path
) -> None:
    pages = sorted(
        path.relative_to(site).as_posix()
        for path in (site / "docs").rglob("*.html")
        if "api/" not in str(path)
    )
    assert len(pages) > 35
    (site / "measure.html").write_text(
        MEASURE.replace("ADDRESSES", json.dumps([f"/{page}" for page in pages])),
        encoding="utf-8",
    )
    text = chromium(
        tmp_path / "browser", f"{address}/measure.html", "--dump-dom", budget=400_000
    ).stdout
    measured = json.loads(
        re.search(r'<pre id="found">(.*?)</pre>', text, re.S)[1].replace("&gt;", ">")
    )
    assert len(measured) == 2 * len(pages)
    assert [
        found for found in measured if found["overflow"] > 0
    ] == []  # no horizontal scrolling
    assert min(found["size"] for found in measured) >= 14
    assert min(found["text"] for found in measured) > 100
    assert [found["address"] for found in measured if found["pictures"]] == []
