"""Creating and saving figures."""

from pathlib import Path

import pytest

from cnpgen.errors import MachineError
from cnpgen.store.files.figure_file import new_figure, save_figure
from tests.refusals import is_refused


@pytest.mark.parametrize("suffix", ["png", "svg"])
def test_a_figure_has_its_size_and_the_format_of_its_suffix(
    tmp_path: Path, suffix: str
) -> None:
    figure, path = new_figure(2, 1), tmp_path / f"picture.{suffix}"
    assert tuple(figure.get_size_inches()) == (2, 1)
    save_figure(figure, path)
    assert path.read_bytes()[:5] == {"png": b"\x89PNG\r", "svg": b"<?xml"}[suffix]


def test_a_figure_that_cannot_be_written_is_a_machine_error(tmp_path: Path) -> None:
    (tmp_path / "no").write_text("a file")
    with is_refused(MachineError):
        save_figure(new_figure(1, 1), tmp_path / "no" / "such" / "folder.png")


def test_the_folder_of_a_figure_is_created(tmp_path: Path) -> None:
    save_figure(new_figure(1, 1), tmp_path / "new" / "folder" / "figure.png")
    assert (tmp_path / "new" / "folder" / "figure.png").is_file()
