"""Where does a running service leave its addresses, so that others find it?

The state file is held locked by its service, so a service that was killed is told from one that runs: the system
releases the lock of a process that is gone.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic, sleep
from types import TracebackType
from typing import Final, Self

from epypes.errors import ServiceError

# Who only reads the state holds the lock for some microseconds; a lock held longer is a service's.
_LOCK_TIMEOUT_S: Final = 1.0
_LOCK_RETRY_S: Final = 0.02


@dataclass(frozen=True, slots=True)
class ServiceState:
    """What a running service says of itself.

    Attributes
    ----------
    pid
        Its process.
    sub, pub
        Where it takes events and where it answers; ``connect:`` in front where it connects.
    digest
        The bundle's.
    failures
        Where failures are published.
    http
        Where it answers over HTTP; empty if it does not.
    token_file
        Where the token for that is kept.
    """

    pid: int
    sub: str
    pub: str
    digest: str
    failures: str = ""
    http: str = ""
    token_file: str = ""


def state_file(bundle: str | Path) -> Path:
    """Return where the state of a bundle's service is kept: in a folder of this user's, not in the bundle."""
    name = hashlib.sha256(str(Path(bundle).resolve()).encode()).hexdigest()[:20]
    return _folder() / f"{name}.json"


def _folder() -> Path:
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(runtime) / "epypes" if runtime else Path(tempfile.gettempdir()) / f"epypes-{os.getuid()}"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if folder.stat().st_uid != os.getuid():
        raise ServiceError(folder, f"{folder} belongs to another user. Set XDG_RUNTIME_DIR to a folder of yours.")
    return folder


class StateLock:
    """The right to serve a bundle, held for as long as the service runs.

    Raises
    ------
    ServiceError
        The bundle is being served; the process is named.
    """

    def __init__(self, bundle: str | Path) -> None:
        self._file = state_file(bundle).open("a+", encoding="utf-8")
        deadline = monotonic() + _LOCK_TIMEOUT_S
        while not self._locked():
            running = read_state(bundle)
            if running or monotonic() > deadline:
                self._file.close()
                by = f"by process {running.pid} at {running.sub}" if running else "by a process that is starting"
                raise ServiceError(bundle, f"{bundle} is being served already, {by}. Stop that one first.")
            sleep(_LOCK_RETRY_S)
        self._write("")

    def _locked(self) -> bool:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return False
        return True

    def publish(self, state: ServiceState) -> None:
        """Let others find the service."""
        self._write(json.dumps(asdict(state)))

    def _write(self, text: str) -> None:
        self._file.truncate(0)
        self._file.write(text)
        self._file.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # The file stays: removing it would let a second service lock a new one while a third waits for this.
        self._write("")
        self._file.close()


def read_state(bundle: str | Path) -> ServiceState | None:
    """Return the state of the service that runs now, or None if none is ready."""
    return _read(state_file(bundle))


def running_at(http: str) -> ServiceState | None:
    """Return the state of the service of this user's that answers over HTTP there, or None if none does."""
    wanted = http.rstrip("/")
    found = (_read(file) for file in _folder().glob("*.json"))
    return next((state for state in found if state is not None and state.http.rstrip("/") == wanted), None)


def _read(path: Path) -> ServiceState | None:
    try:
        with path.open(encoding="utf-8") as file:
            if _can_lock(file.fileno()):
                return None
            text = file.read()
        return _state(json.loads(text)) if text else None
    except (FileNotFoundError, ValueError, TypeError):
        return None


def _state(entries: object) -> ServiceState:
    """Return a state; raise TypeError for anything else that somebody may have written into the file."""
    if not isinstance(entries, dict):
        raise TypeError
    needed = [entries.get(key) for key in ("sub", "pub", "digest")]
    pid, texts = entries.get("pid"), [*needed, *(entries.get(key, "") for key in ("failures", "http", "token_file"))]
    if not isinstance(pid, int) or not all(isinstance(text, str) for text in texts):
        raise TypeError
    return ServiceState(pid, *map(str, texts))


def _can_lock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return False
    fcntl.flock(descriptor, fcntl.LOCK_UN)
    return True
