"""Logs errors, also those whose exceptions can't be printed."""

from __future__ import annotations

import logging

_log = logging.getLogger("epypes.pipeline")


def log_error(text: str, *words: object, error: BaseException | None) -> None:
    """Log an error with its traceback, or without, if the exception does not let itself be shown."""
    try:
        _log.error(text, *words, exc_info=error)
    except BaseException:  # a SystemExit of its __notes__ passes through logging, and would end the thread
        _log.error(f"{text} (its traceback can't be had)", *words)
