"""How docstrings are read for the API page."""

import re

import griffe


class ExampleSections(griffe.Extension):
    """Read a section `Example:` as griffe reads `Examples:`, with its prompts as code."""

    def on_object(self, *, obj: griffe.Object, **kwargs: object) -> None:
        """Rename the section in the docstring of an object."""
        if obj.docstring is not None:
            obj.docstring.value = re.sub(r"^Example:$", "Examples:", obj.docstring.value, flags=re.MULTILINE)
