"""A run that consists of rounds of acting: it continues where it stopped, and ends with one checkpoint."""

from __future__ import annotations

import contextlib
import dataclasses
import pathlib
from collections.abc import Callable
from typing import Any, ClassVar, Protocol, Self, TypeVar

import jax
from flax import nnx

from dipn_jax.commands import console
from dipn_jax.storage import checkpoint, owner, resume
from dipn_jax.system import files


class State(Protocol):
    """State of a run after some rounds: a dataclass that `serialization` has registered."""

    __dataclass_fields__: ClassVar[dict[str, Any]]
    round: int


S = TypeVar("S", bound=State)


class Run:
    """The folder of a run; it has to be entered (`with`), by which this process owns it."""

    def __init__(self, out: pathlib.Path, identity: dict[str, Any]) -> None:
        """Prepare to claim the folder.

        Args:
          out: folder: `config.json`, `checkpoints/`, and `partial.npz` until the end.
          identity: everything that determines the result of the run.
        """
        self.out, self._identity = out, identity
        self._owned = contextlib.ExitStack()
        self._partial = resume.Partial(out, identity)

    def __enter__(self) -> Self:
        """Own and claim the folder.

        Raises:
          UserError: another process has it, or it holds another run.
        """
        with contextlib.ExitStack() as stack:
            stack.enter_context(owner.owned(self.out))
            files.claim(self.out, self._identity)
            self._owned = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._owned.close()

    def ended(self) -> dict[str, Any] | None:
        """Return what was saved at the end; None if the run has not ended."""
        found = checkpoint.newest(self.out)
        return found[1] if found else None

    def play(
        self,
        fresh: Callable[[], S],
        act: Callable[[S], str],
        *,
        total: int,
        what: str,
        trees: dict[str, Any],
        log: Callable[[S], None] = lambda _: None,
    ) -> S:
        """Act until `total` rounds are done.

        Args:
          fresh: the state to begin with.
          act: does one round in place; returns a note for the progress line.
          total: number of rounds.
          what: title of the progress.
          trees: fields of the state that hold pytrees of arrays of any structure, such as an optimizer's, by name: a
            pytree of the same structure.
          log: writes the results of the rounds so far; it depends on the state alone.
        """
        state: S | None = self._partial.load(None)
        if state is None:
            state = fresh()
        else:
            for name, like in trees.items():
                setattr(state, name, jax.tree.unflatten(jax.tree.structure(like), getattr(state, name)))
        with console.Progress(what, total, unit="rounds", done=state.round) as progress:
            while state.round < total:
                note = act(state)
                state.round += 1
                leaves: Any = {name: jax.tree.leaves(getattr(state, name)) for name in trees}
                self._partial.save(dataclasses.replace(state, **leaves))
                log(state)
                progress.advance(1, note)
        log(state)  # again, in case the run was interrupted between saving and logging its last round
        return state

    def finish(self, model: nnx.Module, step: int, *, network: str, config: Any, extra: dict[str, Any]) -> None:
        """Save the network; arguments as of `checkpoint.save`."""
        checkpoint.save(self.out, step, {"model": nnx.state(model)}, network=network, config=config, extra=extra)
        self._partial.finish()
