"""What does each name of a module mean, and which are free?"""

from __future__ import annotations

import builtins
import sys
from collections.abc import Collection, Mapping

from epypes.bundle.cells import names_of
from epypes.bundle.identifiers import identifier_of, is_identifier
from epypes.bundle.source import Definition, Refused

Meaning = tuple[str, object]


def of_object(value: object) -> Meaning:
    """Return the meaning of a name for an object."""
    return "object", id(value)


class Names:
    """The names of a module.

    Parameters
    ----------
    reserved
        The names that the module keeps for the graph.

    Attributes
    ----------
    read
        What functions read by name: these names are theirs before anything is named freely.
    """

    def __init__(self, reserved: Collection[str]) -> None:
        self.reserved = reserved
        self.read: dict[str, object] = {}
        self._meanings: dict[str, Meaning] = {}

    def claim(self, name: str, meaning: Meaning, what: str) -> None:
        """Make a name mean one thing in the module.

        Raises
        ------
        Refused
            It means another.
        """
        if name in self.reserved:
            raise Refused(f"{what} uses the name {name!r}, which the module keeps for the graph. Rename it.")
        if not self.may_mean(name, meaning):
            raise Refused(
                f"{what} uses the name {name!r}, which means something else in another function of the graph. "
                "Rename one of the two."
            )

    def may_mean(self, name: str, meaning: Meaning) -> bool:
        """Whether a name means this, or does from now on because it meant nothing."""
        return self._meanings.setdefault(name, meaning) == meaning

    def is_taken(self, name: str) -> bool:
        """Whether a name means something in the module already."""
        return name in self.reserved or name in self._meanings or name in self.read or hasattr(builtins, name)

    def is_free(self, name: str, value: object) -> bool:
        """Whether a name can mean an object, and hides nothing."""
        if name in self.read:
            return self.read[name] is value
        if name in self.reserved or self._meanings.get(name, of_object(value)) != of_object(value):
            return False
        return not hasattr(builtins, name) and name not in sys.modules

    def name_for(self, function: object, found: Definition, wanted: str) -> str:
        """Return what a function is called in the module: as in the notebook, if that means nothing else there."""
        own, bound = "" if found.is_lambda else found.name, names_of(function, found.names)
        is_known_otherwise = bool(found.captured) or found.names.get(own, function) is not function
        others = [wanted, own] if is_known_otherwise else [own, wanted]
        candidates = [*(name for name in bound if name == own), *bound, *others]
        free = (name for name in candidates if is_identifier(name) and self.is_free(name, function))
        return next(free, "") or identifier_of(own or wanted or found.name, self.is_taken)

    def alias_for(self, value: object, notebook: Mapping[str, object], own: str) -> str:
        """Return the name that a notebook has for an object besides its own; "" if it has none that is free."""
        known = names_of(value, notebook)
        return "" if own in known else next((name for name in known if self.is_free(name, value)), "")
