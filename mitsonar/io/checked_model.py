"""Provide the base of pydantic models whose validation errors are single sentences, even when created directly."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, NoReturn

from pydantic import BaseModel, ValidationError

from mitsonar.errors import MitsonarError, complaint

__all__ = ["CheckedModel"]


if TYPE_CHECKING:  # editors and mypy then infer arguments from the fields of a model, not from its metaclass
    Checked = BaseModel
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
    """Base of models that users create; an invalid field raises a :class:`MitsonarError` with one sentence.

    Attributes:
        called: owner of the fields in that sentence.
        see: reference to a page, for the end of the sentence.
    """

    called: ClassVar[str]
    see: ClassVar[str] = ""

    @classmethod
    def refuse(cls, error: ValidationError) -> NoReturn:
        """Raise a validation error as a single sentence.

        Raises:
            MitsonarError: the first of pydantic's errors.
        """
        raise MitsonarError(complaint(error, cls, cls.called, cls.see)) from None
