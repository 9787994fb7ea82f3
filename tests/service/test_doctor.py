"""The doctor sees what is wrong, and says what helps."""

from __future__ import annotations

import json
import socket
from importlib import metadata

import pytest

from epypes.cli import main
from epypes.service.ops.doctor import examine
from epypes.transport import make_keys

pytestmark = pytest.mark.slow


def found(name, **given):
    return next(check for check in examine(**given) if check.name == name)


def test_a_machine_that_runs_these_tests_is_ready():
    checks = list(examine())
    assert [check.name for check in checks if check.outcome == "failed"] == []
    assert all(not check.way_out for check in checks if check.outcome == "ok")
    assert "median" in next(check for check in checks if check.name == "round trip").found


def test_a_port_in_use_is_named_with_how_to_find_who_has_it():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        check = found(f"address {address}", addresses=[address])
    assert check.outcome == "failed"
    assert "in use" in check.found
    assert "ss -ltnp" in check.way_out
    assert found(f"address {address}", addresses=[address]).outcome == "ok"


def test_what_is_no_address_is_told():
    wrong = ["", "tcp://", "tcp://127.0.0.1", "tcp://127.0.0.1:99999", "5555", "ipc:///tmp/x", "tcp://[::1"]
    checks = {check.name: check for check in examine(addresses=wrong)}
    for address in wrong:
        check = checks[f"address {address}"]
        assert (check.outcome, "tcp://127.0.0.1:5555" in check.way_out) == ("failed", True), address


def test_keys_that_others_can_read_and_keys_that_are_not_there_are_told(tmp_path):
    make_keys(tmp_path / "camera")
    secret = tmp_path / "camera.key_secret"
    make_keys(tmp_path / "robot")
    opened, missing = tmp_path / "robot.key_secret", tmp_path / "none.key_secret"
    opened.chmod(0o644)
    checks = {check.name: check for check in examine(keys=[secret, opened, missing])}
    assert checks[f"keys {secret}"].outcome == "ok"
    assert (checks[f"keys {opened}"].outcome, checks[f"keys {missing}"].outcome) == ("failed", "failed")
    assert "chmod 600" in checks[f"keys {opened}"].way_out + checks[f"keys {opened}"].found


def test_a_missing_or_old_package_is_named_with_the_extra_that_brings_it(monkeypatch):
    known = metadata.version

    def version(name):
        if name == "pyzmq":
            raise metadata.PackageNotFoundError(name)
        return "0.0.1" if name == "protobuf" else known(name)

    monkeypatch.setattr(metadata, "version", version)
    check = found("extra service")
    assert check.outcome == "warning"
    assert "pyzmq" in check.found
    assert "protobuf>=4.25 (is 0.0.1)" in check.found
    assert "epypes[service]" in check.way_out


def test_two_builds_of_opencv_beside_each_other_are_told(monkeypatch):
    monkeypatch.setattr(
        metadata, "packages_distributions", lambda: {"cv2": ["opencv-python", "opencv-python-headless"]}
    )
    monkeypatch.setattr(metadata, "version", lambda name: "5.0")
    check = found("OpenCV")
    assert check.outcome == "failed"
    assert "opencv-python 5.0, opencv-python-headless 5.0" in check.found


def test_a_folder_that_is_no_bundle_fails_the_check_and_those_after_it_are_made(tmp_path):
    checks = {check.name: check for check in examine(tmp_path)}
    assert checks["bundle"].outcome == "failed"
    assert checks["service"].outcome == "warning"


def test_the_command_prints_each_check_and_fails_when_one_fails(capsys, tmp_path):
    with pytest.raises(SystemExit) as ended:
        main(["doctor", "--json"])
    checks = json.loads(capsys.readouterr().out)
    assert (ended.value.code or 0) == 0
    assert {"name", "outcome", "found", "way_out"} == set(checks[0])
    with pytest.raises(SystemExit) as ended:
        main(["doctor", str(tmp_path)])
    assert "Not ready: bundle" in ended.value.code
    assert "failed  bundle" in capsys.readouterr().out
