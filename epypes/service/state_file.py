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
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic, sleep
from types import TracebackType
from typing import Any, Final, Self

from epypes.errors import ServiceError

REPLICA: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,39}")
_MOST_REPLICAS: Final = 1_000
# A reader holds the lock for some microseconds; a lock that is held longer is a service's.
_LOCK_TIMEOUT_S: Final = 1.0
_LOCK_RETRY_S: Final = 0.02
_LOCK_TRIES: Final = 3
# Fields that an earlier version did not write.
_MAY_HAVE: Final = ("failures", "http", "token_file", "replica")


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
    token_file
        The file of the token for that.
    replica
        Name among the services of the bundle; empty for a service that stands alone.
    shows_failures
        Whether commands show the address of failures.
    """

    pid: int
    sub: str
    pub: str
    digest: str
    failures: str = ""
    http: str = ""
    token_file: str = ""
    replica: str = ""
    shows_failures: bool = True


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
        self._file = os.open(state_file(bundle, replica), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        deadline = monotonic() + _LOCK_TIMEOUT_S
        while not self._locked():
            running = _read(state_file(bundle, replica))
            if running or monotonic() > deadline:
                os.close(self._file)
                by = f"by process {running.pid} at {running.sub}" if running else "by a process that is starting"
                named = f" as replica {replica!r}" if replica else ""
                raise ServiceError(bundle, f"{bundle} is being served already{named}, {by}. Stop that one first.")
            sleep(_LOCK_RETRY_S)
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
            if _is_free(state_file(bundle, str(number))):
                with contextlib.suppress(ServiceError):  # another one was faster
                    return cls(bundle, str(number))
        raise ServiceError(bundle, f"{bundle} has {_MOST_REPLICAS} replicas on this machine already. Stop some first.")

    def _locked(self) -> bool:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return False
        return True

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
    """Return the states of the running services of a bundle: of all replicas, or of one by its name."""
    alone = state_file(bundle)
    found = [alone, *sorted(alone.parent.glob(f"{alone.stem}.*.json"), key=_order)]
    files = [state_file(bundle, replica)] if replica else found
    return [state for file in files if (state := _read(file)) is not None]


def _order(file: Path) -> tuple[int, str]:
    """Return the sort key of a replica: 2 before 10."""
    name = file.stem.partition(".")[2]
    return (int(name) if name.isdecimal() else _MOST_REPLICAS), name


def running_at(http: str) -> ServiceState | None:
    """Return the state of this user's service with this HTTP address, or None if there is none."""
    wanted = http.rstrip("/")
    found = (_read(file) for file in _folder().glob("*.json"))
    return next((state for state in found if state is not None and state.http.rstrip("/") == wanted), None)


def _is_free(path: Path) -> bool:
    """Whether no service holds the lock of a state file; a reader holds it for a moment."""
    for _ in range(_LOCK_TRIES):
        try:
            with path.open("a", encoding="utf-8") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return True
        except OSError:
            if _read(path) is not None:
                return False
            sleep(_LOCK_RETRY_S)
    return False


def _read(path: Path) -> ServiceState | None:
    try:
        with path.open(encoding="utf-8") as file:
            if _can_lock(file.fileno()):
                return None
            text = file.read()
        return _state(json.loads(text)) if text.strip() else None
    except (FileNotFoundError, ValueError, TypeError):
        return None


def _state(entries: object) -> ServiceState:
    """Return a state; raise TypeError for other JSON in the file."""
    if not isinstance(entries, dict):
        raise TypeError
    given: dict[str, Any] = {key: entries.get(key) for key in ("sub", "pub", "digest")}
    given |= {key: entries.get(key, "") for key in _MAY_HAVE}
    pid = entries.get("pid")
    if not isinstance(pid, int) or not all(isinstance(text, str) for text in given.values()):
        raise TypeError
    return ServiceState(pid, **given, shows_failures=entries.get("shows_failures") is not False)


def _can_lock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return False
    fcntl.flock(descriptor, fcntl.LOCK_UN)
    return True
