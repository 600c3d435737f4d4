"""What mkdocstrings has to know of the docstrings of this package."""

from typing import Any

import griffe


class Examples(griffe.Extension):
    """Read ``Example:`` as the section ``Examples:``, and describe makers by what they make."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Edit the docstring of one module, class, function or attribute."""
        if obj.docstring:
            obj.docstring.value = obj.docstring.value.replace("Example:\n", "Examples:\n")

    def on_module_members(self, *, mod: griffe.Module, **_: Any) -> None:
        """Give ``together: Make = Together`` the docstring of the class."""
        for one in mod.members.values():
            if isinstance(one, griffe.Attribute) and str(one.annotation) == "Make":
                one.docstring = mod.members[str(one.value)].docstring
