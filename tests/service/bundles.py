"""Bundles of source text, of functions that no notebook would promote."""

from __future__ import annotations

import textwrap

from epypes.bundle.manifest import write_manifest
from epypes.wire import save_sample


def toml(value):
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value) if not isinstance(value, str) else f'"{value}"'


def written_bundle(folder, source, inputs, outputs, *, hyperparameters=(), sample, own=(), states=(), state=({}, {})):
    """Write a bundle whose module is this source; ``sample`` is the inputs and outputs of one run.

    ``states`` are those of the settings, and ``state`` is what the run began with and left.
    """
    (folder / "samples").mkdir(parents=True)
    (folder / "pipeline.py").write_text(textwrap.dedent(source))
    settings = [
        "[bundle]",
        "format = 1",
        f'name = "{folder.name}"',
        "[ports]",
        f"inputs = {list(inputs)!r}".replace("'", '"'),
        f"outputs = {list(outputs)!r}".replace("'", '"'),
    ]
    if own:
        settings.append(f"own = {list(own)!r}".replace("'", '"'))
    if states:
        settings += ["[states]", *(f'"{key}" = "{token}"' for key, token in dict(states).items())]
    for token, value in dict(hyperparameters).items():
        settings += [f"[hyperparameters.{token}]", f"value = {toml(value)}"]
    (folder / "pipeline.toml").write_text("\n".join(settings) + "\n")
    (folder / "requirements.txt").write_text("")
    save_sample(folder / "samples" / "run_1.npz", *sample, state=state[0], state_after=state[1])
    write_manifest(folder)
    return folder
