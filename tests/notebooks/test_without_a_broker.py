"""What does the tutorial on brokers do where none is installed?"""

from __future__ import annotations

from pathlib import Path

import pytest

TUTORIAL = Path(__file__).parents[2] / "notebooks" / "09_beyond_one_machine.ipynb"
# As on a machine that has no server of this name.
HIDDEN = "import shutil\n\nshutil.which = lambda *arguments, **options: None"


@pytest.mark.notebook
def test_each_cell_says_that_no_broker_is_installed_and_none_fails(tmp_path):
    import nbformat  # takes seconds
    from nbclient import NotebookClient

    notebook = nbformat.read(TUTORIAL, as_version=4)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(HIDDEN))
    NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(tmp_path)}}).execute()
    said = [cell.outputs for cell in notebook.cells if cell.cell_type == "code"][1:]
    assert len(said) >= 10
    for outputs in said:
        text = "".join(output["text"] for output in outputs)
        assert text == "Skipped: no broker is installed here. On Debian and Ubuntu: apt install nats-server\n"
    assert not list(tmp_path.iterdir()), "no bundle was promoted"
