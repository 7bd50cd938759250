"""Datasets at URLs: the rows are those of the folder, downloads continue, and damaged or missing files are refused."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Event

import numpy as np
import pytest

import cnpgen
from cnpgen.addons.hub.downloads import ListedFile, RemoteFolder, _fetch
from cnpgen.cli.main import main
from cnpgen.errors import DatasetError, MachineError, MissingExtraError, UsageError
from cnpgen.loader.dataset import Dataset
from tests.addons.hub.servers import COMMIT, Files, serve
from tests.conftest import HANGING
from tests.examples.loader import ALL, columns, make

fsspec = pytest.importorskip("fsspec")
SHARD = "/data/hits/train/shard-00001.h5"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CNPGEN_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return make(tmp_path / "two-shards-v1")


@pytest.fixture
def files(folder: Path) -> Iterator[Files]:
    pytest.importorskip("aiohttp")
    with serve(Files.of_folder(folder, "/data/hits/")) as served:
        yield served


def assert_has_all_rows(dataset: Dataset) -> None:
    for split in dataset:
        rows = dataset.arrays(split, fields=ALL)
        for name, values in columns(split).items():
            assert np.array_equal(rows[name], values), name


def test_a_dataset_in_memory_is_read_by_its_url(folder: Path) -> None:
    system = fsspec.filesystem("memory")
    for path in folder.rglob("*"):
        if path.is_file():
            system.pipe(f"/bucket/hits/{path.relative_to(folder).as_posix()}", path.read_bytes())  # fmt: skip
    assert_has_all_rows(cnpgen.load_dataset("memory://bucket/hits/"))
    system.rm("/bucket", recursive=True)


@pytest.mark.extended
def test_a_dataset_in_s3_is_read_and_its_damaged_bytes_are_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch, cache: Path
) -> None:
    """Needs ``pip install s3fs 'moto[server]'``: a store on this machine."""
    s3fs, moto = pytest.importorskip("s3fs"), pytest.importorskip("moto.server")
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    server.start()
    host, port = server.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "any")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    try:
        store = s3fs.S3FileSystem(skip_instance_cache=True)
        store.mkdir("bucket")
        store.put(str(folder), "bucket/hits", recursive=True)
        assert_has_all_rows(cnpgen.load_dataset("s3://bucket/hits"))
        shard = "bucket/hits/train/shard-00001.h5"
        content = bytearray(store.cat_file(shard))
        content[len(content) // 2] ^= 1
        store.pipe_file(shard, bytes(content))
        shutil.rmtree(cache)
        with pytest.raises(DatasetError, match=r"shard-00001\.h5 is damaged"):
            cnpgen.load_dataset("s3://bucket/hits")
    finally:
        server.stop()


def test_a_second_call_reads_the_manifest_only(files: Files) -> None:
    first = cnpgen.load_dataset(f"{files.url}/data/hits")
    assert_has_all_rows(first)
    files.requests.clear()
    second = cnpgen.load_dataset(f"{files.url}/data/hits")
    assert second.folder == first.folder
    assert second.fingerprint == first.fingerprint
    assert {path for _, path, _ in files.requests} == {"/data/hits/manifest.json"}


def test_a_changed_dataset_is_downloaded_to_another_folder(
    files: Files, tmp_path: Path
) -> None:
    first = cnpgen.load_dataset(f"{files.url}/data/hits")
    changed = make(tmp_path / "other", seed=99)
    files.content = Files.of_folder(changed, "/data/hits/").content
    second = cnpgen.load_dataset(f"{files.url}/data/hits")
    assert second.folder != first.folder
    assert second.spec.seed == 99
    assert_has_all_rows(first)  # is still open


def test_a_repository_of_publish_is_found_in_its_folder(folder: Path) -> None:
    pytest.importorskip("aiohttp")
    with serve(Files.of_folder(folder, "/lab/hits/hdf5/")) as files:
        assert_has_all_rows(cnpgen.load_dataset(f"{files.url}/lab/hits"))


@pytest.mark.parametrize("ranges", [True, False])
def test_an_interrupted_download_continues(files: Files, ranges: bool) -> None:
    files.ranges = ranges
    size = len(files.content[SHARD])
    files.cut[SHARD] = size - 100
    with pytest.raises(MachineError, match=r"interrupted at train/shard-00001\.h5.*the same call continues it"):  # fmt: skip
        cnpgen.load_dataset(f"{files.url}/data/hits")
    files.cut.clear()
    files.requests.clear()
    assert_has_all_rows(cnpgen.load_dataset(f"{files.url}/data/hits"))
    assert files.downloads("specification.json") == []  # of the first call
    again = files.downloads("shard-00001.h5")
    if ranges:
        assert again
        assert 0 < min(again) <= size - 100
    else:
        assert again[-1] == 0


def test_damaged_bytes_are_refused_and_a_repaired_server_is_read(files: Files) -> None:
    good = files.content[SHARD]
    files.content[SHARD] = good[:-8] + b"\xff" * 8
    with pytest.raises(DatasetError, match=r"train/shard-00001\.h5 is damaged: its sha256"):  # fmt: skip
        cnpgen.load_dataset(f"{files.url}/data/hits")
    assert len(files.downloads("shard-00001.h5")) == 2  # downloaded once more
    files.content[SHARD] = good
    assert_has_all_rows(cnpgen.load_dataset(f"{files.url}/data/hits"))


def test_a_copy_without_its_manifest_is_downloaded_again(files: Files) -> None:
    first = cnpgen.load_dataset(f"{files.url}/data/hits")
    (first.folder / "manifest.json").unlink()
    (first.folder / "train" / "shard-00001.h5").write_bytes(b"damaged")
    assert_has_all_rows(cnpgen.load_dataset(f"{files.url}/data/hits"))


def test_a_longer_file_is_not_downloaded_beyond_its_recorded_size(
    files: Files, cache: Path
) -> None:
    files.content[SHARD] += bytes(1 << 20)
    assert_has_all_rows(cnpgen.load_dataset(f"{files.url}/data/hits"))
    (copy,) = cache.glob("datasets/*/*/train/shard-00001.h5")
    assert copy.stat().st_size == len(files.content[SHARD]) - (1 << 20)


def test_a_missing_file_is_named(files: Files) -> None:
    del files.content[SHARD]
    with pytest.raises(DatasetError, match=r"train/shard-00001\.h5 is missing, which manifest\.json lists"):  # fmt: skip
        cnpgen.load_dataset(f"{files.url}/data/hits")


def test_a_dataset_without_its_descriptions_is_complete(files: Files) -> None:
    for name in ("README.md", "croissant.json"):
        files.content.pop(f"/data/hits/{name}", None)
    assert_has_all_rows(cnpgen.load_dataset(f"{files.url}/data/hits"))


def test_a_manifest_that_names_other_paths_is_refused(
    files: Files, cache: Path, tmp_path: Path
) -> None:
    other = Files.of_folder(make(tmp_path / "x", splits={"train": 40}), "/data/hits/")
    files.content["/data/hits/manifest.json"] = other.content["/data/hits/manifest.json"]  # fmt: skip
    with pytest.raises(DatasetError, match="sha256 is not the one in manifest"):
        cnpgen.load_dataset(f"{files.url}/data/hits")
    assert not list(cache.glob("datasets/*/*/manifest.json")) or not [
        path for path in cache.glob("datasets/*/*") if path.suffix == ""
    ]


@pytest.mark.parametrize(
    ("url", "error", "text"),
    [
        ("ftp://host/hits", UsageError, "no installed package reads datasets at ftp://, only "),
        ("memory://nothing", DatasetError, "has no finished dataset"),
        ("memory://hits?x=1", UsageError, "without a query"),
        ("hf://lab/hits", UsageError, "expected hf://datasets/USER/NAME@REVISION"),
        ("hf://datasets/hits", UsageError, "expected hf://datasets/USER/NAME@REVISION"),
        ("http://127.0.0.1:9/hits", MachineError, "cannot be read"),
    ],
)  # fmt: skip
def test_other_urls_are_one_sentence(
    url: str, error: type[Exception], text: str
) -> None:
    if url.startswith("http:"):
        pytest.importorskip("aiohttp")
    with pytest.raises(error, match=text):
        cnpgen.load_dataset(url)


def test_a_missing_package_of_a_store_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(MissingExtraError, match="s3:// needs a package that is missing: pip install s3fs"):  # fmt: skip
        cnpgen.load_dataset("s3://bucket/hits")


def test_commands_take_the_url_of_a_dataset(
    files: Files, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["inspect", f"{files.url}/data/hits"]) == 0
    assert "train" in capsys.readouterr().out


HUB_PROGRAM = """
import sys, cnpgen
dataset = cnpgen.load_dataset(sys.argv[1])
print(dataset.fingerprint, sum(len(dataset.arrays(s)) > 0 for s in dataset), dataset.folder)
"""


def run_with_hub(url: str, home: Path, endpoint: str, **variables: str) -> tuple[int, str]:  # fmt: skip
    """Load a dataset of the Hub in another process, which reads the variables of the library when it starts."""
    environment = os.environ | {
        "HF_HOME": str(home),
        "HF_ENDPOINT": endpoint,
        "HF_HUB_DISABLE_PROGRESS_BARS": "1",
        "HF_HUB_DISABLE_TELEMETRY": "1",
        **variables,
    }
    done = subprocess.run(
        [sys.executable, "-c", HUB_PROGRAM, url],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout + done.stderr


@pytest.mark.slow
def test_a_repository_of_the_hub_is_read_also_offline_from_its_cache(
    folder: Path, tmp_path: Path
) -> None:
    pytest.importorskip("huggingface_hub")
    home, url = tmp_path / "hf", "hf://datasets/lab/hits@v1"
    expected = cnpgen.load_dataset(folder).fingerprint
    files = Files.of_folder(folder, "/datasets/lab/hits/resolve/v1/hdf5/")
    for path in list(files.content):  # a tag, and its commit
        files.content[path.replace("/v1/", f"/{COMMIT}/")] = files.content[path]
    with serve(files):
        code, text = run_with_hub(url, home, files.url)
        assert code == 0, text
        assert text.split()[0] == expected
        copy = Path(text.split()[-1])
        assert copy.is_relative_to(home / "assets")
        blobs = {path.stat().st_ino for path in (home / "hub").rglob("blobs/*")}
        shard = copy / "train" / "shard-00001.h5"
        assert shard.stat().st_ino in blobs  # the same file, not a second one
        assert not shard.is_symlink()
    code, text = run_with_hub(url, home, files.url, HF_HUB_OFFLINE="1")
    assert (code, text.split()[0]) == (0, expected), text
    code, text = run_with_hub(f"{url}x", home, files.url, HF_HUB_OFFLINE="1")
    assert code == 1
    assert f"MachineError: {url}x cannot be read" in text


def test_an_error_ends_the_files_in_transfer(tmp_path: Path) -> None:
    ended = list[str]()

    class Slow(RemoteFolder):
        url = "slow://x"

        def save(
            self, name: str, path: Path, *, max_bytes: int, anew: bool, stop: Event
        ) -> None:
            if name == "broken":
                raise ConnectionError("no answer")
            assert stop.wait(HANGING)
            ended.append(name)
            raise InterruptedError

    files = [ListedFile(name, "") for name in ("slow-1", "slow-2", "broken")]
    with pytest.raises(MachineError, match="interrupted at"):
        _fetch(Slow(), tmp_path, files)
    assert sorted(ended) == ["slow-1", "slow-2"]
