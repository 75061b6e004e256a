# SPDX-License-Identifier: Apache-2.0
"""Definition of a built-in cost term: keys that become kernel parameters by their types, and one Warp function."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, get_args

import warp as wp

from ..kernels.cost.norms import Norm
from ..scene.types import Section
from .term import CostTerm, parse_keys

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

    from .binding import Binding

_FRAME, _OBJECT = "frame", "object"
Frame = Annotated[str, _FRAME]
"""Name of a frame, which becomes its index."""
Object = Annotated[str, _OBJECT]
"""Name of an object with a primitive shape, which becomes the index of its frame."""


class TermKeys(Section):
    """Keys of a term in a scene file, and the parameters of its Warp function that they become.

    A key of one of these types becomes a field of the ``wp.struct`` :attr:`Params` by the same name: a number, a flag
    (0 or 1), a frame or an object (:data:`Frame`, :data:`Object`, its index), a tuple of frames (an array of indices),
    a norm. Other fields of the struct are in :attr:`derived`; :meth:`bind` fills them.
    """

    derived: ClassVar[dict[str, Any]] = {}
    """Further fields of the struct, with their Warp types."""
    Params: ClassVar[Any]

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        super().__pydantic_init_subclass__(**kwargs)
        kinds = {name: kind for name, field in cls.model_fields.items() if (kind := _kernel_type(name, field))}
        body = {"__annotations__": kinds | cls.derived, "__module__": cls.__module__, "__doc__": cls.__doc__}
        cls.Params = wp.struct(type(f"{cls.__name__}Params", (), body))

    def parameters(self, b: Binding) -> Any:
        """Fill a struct from these keys.

        Raises:
            SceneError: If a key names what the scene does not have.
        """
        p = self.Params()
        for name, field in type(self).model_fields.items():
            kind, value = _kernel_type(name, field), getattr(self, name)
            if kind is None or name in self.derived:
                continue
            if kind is Norm:
                value = value.struct()
            elif isinstance(value, str):
                if _OBJECT in field.metadata:
                    b.object_shape(value, name)
                value = b.frame(value, name)
            elif isinstance(value, tuple):
                value = b.array([b.frame(frame, name) for frame in value], dtype=int)
            setattr(p, name, int(value) if kind is int else value)
        self.bind(p, b)
        return p

    def bind(self, p: Any, b: Binding) -> None:
        """Fill the derived fields; keys that have some override this.

        Args:
            p: The struct, whose other fields are filled.
            b: What the scene has.

        Raises:
            SceneError: If a key names what the scene does not have.
        """


def _kernel_type(name: str, field: FieldInfo) -> Any:
    """Warp type that a key has in the struct; None where it has no field there."""
    kind = field.annotation
    if name == "norm":
        return Norm
    if kind is float:
        return float
    if kind is bool or (kind is str and {_FRAME, _OBJECT} & {*map(str, field.metadata)}):
        return int
    return wp.array[int] if get_args(kind)[:1] == (Frame,) else None


def term(name: str, keys: type[TermKeys], **fields: Any) -> Callable[[Callable], CostTerm]:
    """Turn a function of one step into a built-in cost term.

    Args:
        name: What scene files call it.
        keys: Its keys, whose ``Params`` the function takes.
        fields: Further fields of the :class:`~warpmpc.cost.term.CostTerm`.
    """

    def bind(values: dict[str, Any], b: Binding) -> Any:
        return parse_keys(keys, values, b).parameters(b)

    def decorate(function: Callable) -> CostTerm:
        made = function if isinstance(function, wp.Function) else wp.func(function)
        return CostTerm(name, made, keys.Params, bind, keys, **fields)

    return decorate
