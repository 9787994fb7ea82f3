"""Systemd units and container folders have what a machine needs."""

from __future__ import annotations

import shutil
import subprocess

import cv2
import pytest

import epypes as ep
from epypes.bundle.manifest import check_manifest
from epypes.cli import main
from epypes.errors import BundleError, ServiceError
from epypes.service.ops.export import systemd_unit, unit_name, write_container

SYSTEMD = shutil.which("systemd-analyze")


@pytest.fixture(scope="module")
def bundle(tmp_path_factory, photograph):
    cg = ep.CompGraph({"canny": cv2.Canny}, {"canny": (("image", "lo", "hi"), "edges")})
    runner = ep.CompGraphRunner(cg, {"lo": 70, "hi": 200})
    runner.run(image=photograph)
    return ep.promote(runner, tmp_path_factory.mktemp("bundles") / "Edges of 50% & 1").path


def command_of(unit):
    return next(line for line in unit.splitlines() if line.startswith("ExecStart="))


@pytest.mark.slow
def test_a_unit_starts_the_service_as_the_user_and_says_how_it_is_used(bundle):
    unit = systemd_unit(bundle, ["--sub", "tcp://127.0.0.1:5555"], user="vision")
    assert "User=vision" in unit
    assert "serve" in command_of(unit)
    assert "--sub tcp://127.0.0.1:5555" in command_of(unit)
    assert unit_name(bundle) == "epypes-edges-of-50-1.service"
    assert unit_name(bundle) in unit


def test_what_means_something_to_systemd_is_quoted(bundle):
    unit = systemd_unit(bundle, ["--pub", 'ipc://a "b" $HOME %h \\ c'], user="vision")
    command = command_of(unit)
    assert "Edges of 50%% & 1" in command
    assert '"ipc://a \\"b\\" $$HOME %%h \\\\ c"' in command
    assert len(unit.splitlines()) == len(systemd_unit(bundle, user="vision").splitlines())


def test_replicas_on_a_broker_have_one_unit_with_an_instance_for_each(bundle):
    options = ["--sub", "amqp://robot@127.0.0.1/events?password_file=/etc/robot.password"]
    unit = systemd_unit(bundle, options, user="vision")
    assert unit_name(bundle, options) == "epypes-edges-of-50-1@.service"
    assert command_of(unit).endswith("--replica %i")
    assert "enable --now epypes-edges-of-50-1@1.service epypes-edges-of-50-1@2.service" in unit
    assert "RuntimeDirectoryPreserve=yes" in unit
    assert "RuntimeDirectoryPreserve" not in systemd_unit(bundle, [*options, "--replica", "a"], user="vision")


def test_a_password_is_written_into_no_unit_and_no_image(bundle, tmp_path):
    options = ["--pub=amqp://robot:hush@127.0.0.1/answers"]
    for write in (
        lambda: systemd_unit(bundle, options, user="vision"),
        lambda: write_container(bundle, tmp_path, options),
    ):
        with pytest.raises(ServiceError, match="password_file") as error:
            write()
        assert "hush" not in str(error.value)


@pytest.mark.skipif(SYSTEMD is None, reason="systemd is not installed here")
def test_systemd_takes_the_unit(bundle, tmp_path):
    file = tmp_path / unit_name(bundle)
    file.write_text(systemd_unit(bundle, ["--http", "http://127.0.0.1:8642"], user="root"), encoding="utf-8")
    done = subprocess.run([SYSTEMD, "verify", "--man=no", str(file)], capture_output=True, text=True, check=False)
    about = [line for line in done.stderr.splitlines() if file.name in line]
    assert (done.returncode, about) == (0, [])
    file.write_text(file.read_text(encoding="utf-8").replace("KillMode=mixed", "KillMode=sometimes"), encoding="utf-8")
    done = subprocess.run([SYSTEMD, "verify", "--man=no", str(file)], capture_output=True, text=True, check=False)
    assert "kill mode" in done.stderr


@pytest.mark.slow
@pytest.mark.packaging
def test_a_container_is_built_from_the_bundle_and_what_it_requires(bundle, tmp_path):
    path = write_container(bundle, tmp_path / "image", ["--threads", "2"])
    text = path.read_text(encoding="utf-8")
    assert 'ENTRYPOINT ["epypes", "serve", "/service/bundle", "--threads", "2"]' in text
    assert "USER epypes" in text
    assert check_manifest(path.parent / "bundle") == check_manifest(bundle)
    lines = (path.parent / "requirements.txt").read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if line.startswith("epypes")] == [f"epypes[serve]=={ep.__version__}"]
    assert any(line.startswith("opencv-python-headless==") for line in lines)
    (wheel,) = (path.parent / "wheels").iterdir()
    assert wheel.name == f"epypes-{ep.__version__}-py3-none-any.whl"
    assert "COPY wheels" in text


def test_a_folder_that_is_not_empty_is_left_alone(bundle, tmp_path):
    (tmp_path / "mine.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(ServiceError, match="not empty"):
        write_container(bundle, tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["mine.txt"]


def test_a_bundle_that_was_changed_is_not_exported(bundle, tmp_path):
    spoilt = shutil.copytree(bundle, tmp_path / "spoilt")
    (spoilt / "pipeline.py").write_text("", encoding="utf-8")
    with pytest.raises(BundleError):
        systemd_unit(spoilt, user="vision")
    with pytest.raises(BundleError):
        write_container(spoilt, tmp_path / "image")


def run(*arguments):
    with pytest.raises(SystemExit) as ended:
        main(list(map(str, arguments)))
    return ended.value.code or 0


def test_the_command_writes_a_unit_and_refuses_options_that_serve_does_not_take(bundle, tmp_path, capsys):
    assert run("export", "systemd", bundle, "--user", "vision", "--", "--sub", "tcp://127.0.0.1:5555") == 0
    assert "--sub tcp://127.0.0.1:5555" in capsys.readouterr().out
    assert run("export", "systemd", bundle, "--to", tmp_path) == 0
    assert (tmp_path / unit_name(bundle)).is_file()
    assert run("export", "systemd", bundle, "--", "--sob", "x") == 2
    assert "--sob" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.packaging
def test_the_command_writes_a_container(bundle, tmp_path, capsys):
    assert run("export", "docker", bundle, "--to", tmp_path / "image") == 0
    assert "FROM python:" in (tmp_path / "image" / "Containerfile").read_text(encoding="utf-8")
