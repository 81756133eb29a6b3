"""Where outcomes are kept: a file each, named by the digest of its request, whole or not at all.

Any number of processes, on any number of machines that share the folder, may write to a store at once: a run is a
function of its request, so every writer of a file writes the same bytes.
"""

from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from coldloop.errors import ResultsError
from coldloop.whole_file import whole_text
from coldloop_rig.results.folders import writing
from coldloop_rig.studies.request import Outcome, RunRequest

REMEMBERED: Final = 64
"""Outcomes kept in memory: some MB each when they have a trace."""


class Store:
    """Outcomes by the digest of their request."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, request: RunRequest) -> Path:
        """Return where an outcome is kept."""
        return self.folder / f"{request.digest}.json"

    def text(self, request: RunRequest) -> str | None:
        """Return the file of a request if it is there and whole."""
        try:
            text = self.path(request).read_text(encoding="utf-8")
            Outcome.from_json(text)
        except (OSError, ValueError):
            return None
        return text

    def find(self, request: RunRequest) -> Outcome | None:
        """Return the outcome of a request if it is there and whole."""
        text = self.text(request)
        return None if text is None else Outcome.from_json(text)

    def keep(self, request: RunRequest, outcome: str) -> None:
        """Keep an outcome.

        Raises:
            ResultsError: It cannot be written.
        """
        path = self.path(request)
        with writing(path, "what was done before is kept: make room, or choose another --out"):
            whole_text(path, outcome)


class StoredOutcomes(Mapping[RunRequest, Outcome]):
    """The outcomes of some requests, read when they are wanted: a large study has more than memory holds."""

    def __init__(self, store: Store, requests: Sequence[RunRequest]) -> None:
        self._store = store
        self._requests = dict.fromkeys(requests)
        self._recent: OrderedDict[RunRequest, Outcome] = OrderedDict()

    def __getitem__(self, request: RunRequest) -> Outcome:
        """Return an outcome.

        Raises:
            ResultsError: Its file is gone, or is not whole any more.
        """
        if request not in self._requests:
            raise KeyError(request)
        if request not in self._recent:
            outcome = self._store.find(request)
            if outcome is None:
                raise ResultsError(f"{self._store.path(request)}: gone or damaged since it was written; do it again")
            self._recent[request] = outcome
            if len(self._recent) > REMEMBERED:
                self._recent.popitem(last=False)
        self._recent.move_to_end(request)
        return self._recent[request]

    def __iter__(self) -> Iterator[RunRequest]:
        """Go through the requests, in the order in which they were given."""
        return iter(self._requests)

    def __len__(self) -> int:
        """Return how many requests there are."""
        return len(self._requests)
