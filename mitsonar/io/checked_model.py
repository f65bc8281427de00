"""How the models that users create are checked, with errors of one sentence, and how presets of them are read."""

from __future__ import annotations

from importlib.resources import files
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, NoReturn, Self

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from mitsonar.errors import MitsonarError, validation_message

__all__ = ["CheckedModel", "Preset", "presets_in"]


if TYPE_CHECKING:  # editors and mypy then infer arguments from the fields of a model, not from its metaclass
    from pydantic import BaseModel as Checked  # no alias: mypy's plugin would not see the configuration of CheckedModel
else:

    class OneSentence(type(BaseModel)):
        """Metaclass that converts validation errors of ``Model(...)``, and leaves nested models to pydantic."""

        def __call__(cls, *args: Any, **fields: Any) -> Any:
            """Create a model.

            Raises:
                MitsonarError: an unknown key, a value outside its limits.
            """
            try:
                return super().__call__(*args, **fields)
            except ValidationError as error:
                cls.refuse(error)

    class Checked(BaseModel, metaclass=OneSentence):
        """A pydantic model with this metaclass."""


class CheckedModel(Checked):
    """Base of frozen models that users create; an invalid field raises a :class:`MitsonarError` with one sentence.

    Attributes:
        called: owner of the fields in that sentence.
        see: reference to a page, for the end of the sentence.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    called: ClassVar[str]
    see: ClassVar[str] = ""

    @classmethod
    def create(cls, **fields: Any) -> Self:
        """Create a model from its fields.

        Raises:
            MitsonarError: an unknown key, a value outside its limits, or values that contradict each other.
        """
        return cls(**fields)

    @classmethod
    def refuse(cls, error: ValidationError) -> NoReturn:
        """Raise a validation error as a single sentence.

        Raises:
            MitsonarError: the first of pydantic's errors.
        """
        raise MitsonarError(validation_message(error, cls, cls.called, cls.see)) from None


class Preset(NamedTuple):
    """A model that ships with the package.

    Attributes:
        about: description, such as the instrument and its mode.
        values: values of the fields, by name.
        sources: source of each value.
    """

    about: str
    values: dict[str, Any]
    sources: dict[str, str]


def presets_in(package: str, folder: str) -> dict[str, Preset]:
    """Return the presets in a folder of a package, by name: those of a file's ``modes``, or else the file itself."""
    presets = {}
    for path in sorted((files(package) / folder).iterdir(), key=lambda path: path.name):
        table = yaml.safe_load(path.read_text(encoding="utf-8"))
        for name, mode in table.get("modes", {path.name.removesuffix(".yaml"): table}).items():
            keys = {**table["keys"], **mode["keys"]}.items()
            values, sources = ({key: one[part] for key, one in keys} for part in ("value", "source"))
            presets[name] = Preset(mode["about"], values, sources)
    return presets
