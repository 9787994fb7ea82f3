"""A bundle that was tampered with: nothing runs it unasked, and nothing in it that is no regular file is opened."""

from __future__ import annotations

import os
import socket

import pytest

import epypes as ep
from epypes.bundle import verify, write_back
from epypes.bundle.load import read_bundle
from epypes.bundle.manifest import MANIFEST, MOST_BYTES, write_manifest
from epypes.errors import BundleChanged, BundleError, DeployRefused
from epypes.service import Service
from tests.service.served import acting_bundle


@pytest.fixture(autouse=True)
def apart(own_folders):
    """Services of these tests have folders of their own."""


@pytest.fixture
def folder(tmp_path):
    return acting_bundle(tmp_path / "acting")


@pytest.fixture
def tampered(tmp_path):
    """A bundle whose code, changed since, leaves a file when it is run."""
    folder = acting_bundle(tmp_path / "tampered")
    module = folder / "pipeline.py"
    module.write_text(f"{module.read_text()}\nopen({str(tmp_path / 'ran')!r}, 'w').close()\n")
    return folder


@pytest.mark.parametrize("fresh_env", [False, True])
def test_verify_runs_nothing_of_what_it_has_just_found_changed(tampered, tmp_path, fresh_env):
    with pytest.raises(BundleChanged, match="pipeline.py was changed.*Nothing of it was run"):
        verify(tampered, fresh_env=fresh_env)
    assert not (tmp_path / "ran").exists()


@pytest.mark.slow
def test_verify_runs_a_changed_bundle_anyway_if_it_is_asked_to_and_refuses_it_all_the_same(tampered, tmp_path):
    with pytest.raises(BundleChanged, match="pipeline.py was changed.* It still computes what was recorded"):
        verify(tampered, run_anyway=True)
    assert (tmp_path / "ran").exists()


def test_a_manifest_with_two_digests_for_a_file_is_refused(folder, tampered, tmp_path):
    write_manifest(tampered)
    module = [line for line in (tampered / MANIFEST).read_text().splitlines() if line.endswith("  pipeline.py")]
    with (folder / MANIFEST).open("a") as manifest:
        manifest.write(f"{module[0]}\n")
    with pytest.raises(BundleError, match="two digests for 'pipeline.py'"):
        ep.load(folder)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("use", [ep.load, lambda path: ep.load_pipeline(path, None, None), Service])
def test_nothing_runs_a_bundle_that_was_tampered_with_unasked(tampered, tmp_path, use):
    with pytest.raises(BundleChanged, match="pipeline.py was changed"):
        use(tampered)
    assert not (tmp_path / "ran").exists()


@pytest.mark.slow
def test_a_running_service_refuses_to_be_deployed_a_bundle_that_was_tampered_with(folder, tampered, tmp_path):
    with Service(folder) as service:
        with pytest.raises(DeployRefused, match="pipeline.py was changed"):
            service.deploy(tampered)
        assert service.state == "READY"
    assert not (tmp_path / "ran").exists()


@pytest.mark.slow
def test_a_worker_does_not_run_a_bundle_that_was_tampered_with_since_the_service_began(folder, tmp_path):
    with Service(folder) as service:
        module = folder / "pipeline.py"
        module.write_text(f"{module.read_text()}\nopen({str(tmp_path / 'ran')!r}, 'w').close()\n")
        os.kill(service.info()["worker_pid"], 9)
        service._dispatcher.wait_for(lambda: service.state == "FAULTED", 60)
        assert "pipeline.py was changed" in service.reason
    assert not (tmp_path / "ran").exists()


def fifo(path, outside):
    os.mkfifo(path)


def endless(path, outside):
    path.symlink_to("/dev/zero")


def elsewhere(path, outside):
    path.symlink_to(outside)


def listening(path, outside):
    os.chdir(path.parent)  # the whole path may be too long for a socket's
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(path.name)


PUT = [fifo, endless, elsewhere, listening]
SAMPLE = "samples/run_1.npz"


def readers(folder):
    """Return what reads a bundle's files, each to be called."""
    runner = ep.load(folder)
    runner.run(what="plain", number=3)
    return [
        lambda: verify(folder),
        lambda: verify(folder, run_anyway=True),
        lambda: ep.load(folder),
        lambda: ep.load_pipeline(folder, None, None),
        lambda: Service(folder),
        lambda: write_back(folder, {"k": 7}),
        lambda: read_bundle(folder, compare=False),
        lambda: ep.promote(runner, folder),
    ]


@pytest.mark.parametrize(
    ("name", "put"),
    [*((SAMPLE, put) for put in PUT), ("samples/more.npz", fifo), ("pipeline.py", fifo), ("pipeline.toml", endless)],
)
def test_a_fifo_a_device_link_or_a_socket_in_a_bundle_is_refused_by_all_that_reads_it(
    folder, tmp_path, name, put, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    path, outside = folder / name, tmp_path / "outside"
    uses = readers(folder)
    outside.write_bytes(path.read_bytes() if path.exists() else b"")
    path.unlink(missing_ok=True)
    put(path, outside)
    for use in uses:
        with pytest.raises(BundleError, match=f"{name}, which is not a plain file"):
            use()


@pytest.mark.parametrize("name", ["pipeline.py", "pipeline.toml"])
def test_a_bundle_whose_manifest_covers_only_a_part_is_refused(folder, name):
    (folder / name).unlink()
    write_manifest(folder)
    for use in (ep.load, verify):
        with pytest.raises(BundleError, match=name):
            use(folder)


@pytest.mark.parametrize("put", [fifo, endless, elsewhere])
def test_a_manifest_that_is_no_regular_file_is_refused(folder, tmp_path, put):
    *uses, unsealed, promoting = readers(folder)
    outside = (folder / MANIFEST).rename(tmp_path / "outside")
    put(folder / MANIFEST, outside)
    for use in (*uses, unsealed):
        with pytest.raises(BundleError, match=f"{MANIFEST}, which is not a plain file"):
            use()
    with pytest.raises(BundleError, match="exists and is not a bundle|is not a plain file"):
        promoting()


def test_a_folder_that_holds_more_than_a_bundle_may_is_refused_before_it_is_read(folder):
    sparse = folder / "samples" / "sparse.npz"
    with sparse.open("wb") as file:
        file.truncate(MOST_BYTES)
    with pytest.raises(BundleError, match=r"holds more than 8 GB, up to "):
        verify(folder)
    sparse.unlink()
    with (folder / "pipeline.py").open("wb") as file:
        file.truncate(2**30)
    with pytest.raises(BundleError, match=r"pipeline.py is larger than 64 MB"):
        ep.load(folder)


BROKEN_MODULES = {
    "import no_such_package": r"can't be imported at line \d+, 'import no_such_package': ModuleNotFoundError.*'no_such_package'.*install what its requirements\.txt lists",
    "from numpy import no_such_name": r"can't be imported at line \d+.*: ImportError.*'no_such_name'.*install what its requirements\.txt",
    "del func_io, func_dict": r"pipeline\.py defines no 'func_dict', 'func_io', which the bundle needs\. Promote the graph again",
}


@pytest.mark.parametrize("line", BROKEN_MODULES)
def test_a_module_that_lacks_something_is_named_with_the_way_out(line, folder):
    module = folder / "pipeline.py"
    module.write_text(f"{module.read_text()}\n{line}\n")
    write_manifest(folder)
    with pytest.raises(BundleError, match=BROKEN_MODULES[line]):
        ep.load(folder)


def test_what_the_code_of_a_bundle_raises_when_it_is_imported_stays_its_own_error(folder):
    module = folder / "pipeline.py"
    module.write_text(f"{module.read_text()}\nabs('text')\n")
    write_manifest(folder)
    with pytest.raises(TypeError, match="abs"):
        ep.load(folder)
