"""Structures passed by reference between compiled functions.

numba passes a NamedTuple of arrays by value: seven numbers or more for each array, some 400 for an `OrganModel`, at
every call. A reference is one address: the first step compiles in 0.92 of the time.
"""

import hashlib
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.errors import LoweringError
from numba.core.imputils import impl_ret_borrowed
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, lower_getattr_generic, models, register_model

from msdm_core.kernels.vector_kernels import intrinsic


class StructureReference(types.Type):
    """The type of a reference to a NamedTuple; its fields are read as those of the NamedTuple are."""

    def __init__(self, structure: types.NamedTuple) -> None:
        self.structure = structure
        super().__init__(name=f"StructureReference({structure})")

    @property
    def instance_class(self) -> type:
        """The class of the NamedTuple, as `types.NamedTuple.instance_class`."""
        return self.structure.instance_class

    @property
    def mangling_args(self) -> tuple[str, tuple]:
        """What stands for this type in names of compiled functions; numba would write out the types of all fields."""
        digest = hashlib.sha256(self.name.encode()).hexdigest()[:16]
        return f"{self.structure.instance_class.__name__}Reference{digest}", ()


@register_model(StructureReference)
class _AddressModel(models.PrimitiveModel):
    """A reference is the address of the structure."""

    def __init__(self, models_known: Any, reference: StructureReference) -> None:
        address = models_known.lookup(reference.structure).get_value_type().as_pointer()
        super().__init__(models_known, reference, address)


@infer_getattr
class _Fields(AttributeTemplate):
    key = StructureReference

    def generic_resolve(self, reference: StructureReference, name: str) -> types.Type | None:
        """The type of a field; None where there is no such field, which numba reports."""
        fields = reference.structure.fields
        return reference.structure.types[fields.index(name)] if name in fields else None


@lower_getattr_generic(StructureReference)
def _load_field(context: Any, builder: Any, reference: StructureReference, address: ir.Value, name: str) -> ir.Value:
    index = reference.structure.fields.index(name)
    value = builder.load(cgutils.gep_inbounds(builder, address, 0, index))
    return impl_ret_borrowed(context, builder, reference.structure.types[index], value)


@intrinsic
def by_reference(_typing_context, structure):
    """A reference to a NamedTuple, which the compiled function that calls this keeps until it returns.

    A function must not return a reference that it made. A reference is returned as it is.

    Raises:
        LoweringError: the function counts references to arrays (it is compiled without `_nrt=False`), and an array
            might be freed while its structure is still referred to
    """
    if isinstance(structure, StructureReference):
        return structure(structure), lambda _context, _builder, _signature, values: values[0]
    if isinstance(structure, types.NamedTuple):
        return StructureReference(structure)(structure), _keep
    return None


def _keep(context: Any, builder: Any, _signature: Any, values: Any) -> ir.Value:
    if context.enable_nrt:
        raise LoweringError(
            "by_reference is for functions without numba's runtime, which frees arrays that only a reference holds: "
            "decorate the function with KERNEL, INNER or INLINED of msdm_core/kernels/option_kernels.py"
        )
    return cgutils.alloca_once_value(builder, values[0])
