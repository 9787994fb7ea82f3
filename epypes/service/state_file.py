"""State files: where a running service publishes its addresses and its process.

A service keeps its state file locked, and the system releases the lock of a process that is gone: so the file of a
killed service is not taken for that of a running one. Replicas, which share the events of a broker, have a file each.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import re
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from time import sleep
from types import TracebackType
from typing import Final, NoReturn, Self

from epypes.errors import ServiceError

REPLICA: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,39}")
_MOST_REPLICAS: Final = 1_000
# A reader holds the lock for some microseconds; a lock that is held longer is a service's.
_LOCK_TRIES: Final = 25
_LOCK_RETRY_S: Final = 0.02


@dataclass(frozen=True, slots=True)
class ServiceState:
    """The contents of a state file.

    Attributes
    ----------
    pid
        Its process.
    sub, pub
        Addresses of events and of answers; ``connect:`` in front where it connects.
    digest
        The bundle's.
    failures
        Address of failures.
    http
        Address of its HTTP control; empty without.
    access_key_file
        The file of the access key for that.
    replica
        Name among the services of the bundle; empty for a service that stands alone.
    shows_failures
        Whether commands show the address of failures.
    bundle
        The folder that it serves now: not the one that it was started with once another one was deployed.
    """

    pid: int
    sub: str
    pub: str
    digest: str
    failures: str = ""
    http: str = ""
    access_key_file: str = ""
    replica: str = ""
    shows_failures: bool = True
    bundle: str = ""


def state_file(bundle: str | Path, replica: str = "") -> Path:
    """Return the path of a service's state file: in a folder of this user, not in the bundle."""
    name = hashlib.sha256(str(Path(bundle).resolve()).encode()).hexdigest()[:20]
    return _folder() / (f"{name}.{replica}.json" if replica else f"{name}.json")


def _folder() -> Path:
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(runtime) / "epypes" if runtime else Path(tempfile.gettempdir()) / f"epypes-{os.getuid()}"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if folder.stat().st_uid != os.getuid():
        raise ServiceError(folder, f"{folder} belongs to another user. Set XDG_RUNTIME_DIR to a folder of yours.")
    return folder


class StateLock:
    """The right to serve a bundle, held for as long as the service runs.

    Parameters
    ----------
    bundle
        Its folder.
    replica
        Name among several services; empty for one that stands alone.

    Raises
    ------
    ServiceError
        The bundle is being served under this name, by the process in the text; or the name is not valid.
    """

    def __init__(self, bundle: str | Path, replica: str = "") -> None:
        if replica and not REPLICA.fullmatch(replica):
            text = f"A replica can't be called {replica!r:.60}. Take at most 40 letters, digits, '.', '_' and '-'."
            raise ServiceError(bundle, text)
        self.replica = replica
        path = state_file(bundle, replica)
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        for _ in range(_LOCK_TRIES):
            if _can_lock(self._file, fcntl.LOCK_EX):
                break
            if running := _read(path):
                self._refuse(bundle, f"by process {running.pid} at {running.sub}")
            sleep(_LOCK_RETRY_S)
        else:
            self._refuse(bundle, "by a process that is starting")
        self._write("")

    @classmethod
    def of_next(cls, bundle: str | Path) -> Self:
        """Return the lock of the replica with the first free number.

        Raises
        ------
        ServiceError
            There are too many.
        """
        for number in range(1, _MOST_REPLICAS + 1):
            with contextlib.suppress(ServiceError):
                return cls(bundle, str(number))
        raise ServiceError(bundle, f"{bundle} has {_MOST_REPLICAS} replicas on this machine already. Stop some first.")

    def _refuse(self, bundle: str | Path, by: str) -> NoReturn:
        os.close(self._file)
        named = f" as replica {self.replica!r}" if self.replica else ""
        raise ServiceError(bundle, f"{bundle} is being served already{named}, {by}. Stop that one first.")

    def publish(self, state: ServiceState) -> None:
        """Write the state into the file."""
        self._write(json.dumps(asdict(state)))

    def _write(self, text: str) -> None:
        # In one step, over the old text: a reader finds the one or the other, and never nothing.
        data = text.encode()
        os.pwrite(self._file, data.ljust(os.fstat(self._file).st_size), 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # The file stays: without it a second service could lock a new file while a third waits for this one.
        self._write("")
        os.close(self._file)


def read_states(bundle: str | Path, replica: str = "") -> list[ServiceState]:
    """Return the states of this user's running services of a bundle: of all replicas, or of one by its name.

    A service is found by the bundle that it was started with; else by the one that it serves now.
    """
    alone = state_file(bundle)
    started = [alone, *sorted(alone.parent.glob(f"{alone.stem}.*.json"), key=_order)]
    found = [_read(file) for file in ([state_file(bundle, replica)] if replica else started)]
    folder = str(Path(bundle).resolve())
    return [state for state in found if state is not None] or [
        state for state in running_states() if state.bundle == folder and replica in ("", state.replica)
    ]


def _order(file: Path) -> tuple[int, str]:
    """Return the sort key of a replica: 2 before 10."""
    name = file.stem.partition(".")[2]
    return (int(name) if name.isdecimal() else _MOST_REPLICAS), name


def running_at(http: str) -> ServiceState | None:
    """Return the state of this user's service with this HTTP address, or None if there is none."""
    wanted = http.rstrip("/")
    return next((state for state in running_states() if state.http.rstrip("/") == wanted), None)


def running_states() -> Iterator[ServiceState]:
    """Yield the states of all running services of this user."""
    for file in sorted(_folder().glob("*.json")):
        if (state := _read(file)) is not None:
            yield state


def _read(path: Path) -> ServiceState | None:
    """Return the state in a file; None if no service holds its lock, or has published a state yet."""
    try:
        with path.open(encoding="utf-8") as file:
            if _can_lock(file.fileno(), fcntl.LOCK_SH):
                return None
            entries = json.load(file)
        known = {each.name: entries[each.name] for each in fields(ServiceState) if each.name in entries}
        return ServiceState(**known)
    except (FileNotFoundError, ValueError, TypeError):
        return None


def _can_lock(descriptor: int, kind: int) -> bool:
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
