"""Models of pydantic whose mistakes are one sentence, also where they are created by their class."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, NoReturn

from pydantic import BaseModel, ValidationError

from mitsonar.errors import MitsonarError, complaint

__all__ = ["CheckedModel"]


if TYPE_CHECKING:  # editors and mypy read the fields of a model, not the arguments of its metaclass
    Checked = BaseModel
else:

    class OneSentence(type(BaseModel)):
        """The metaclass: it answers mistakes of ``Model(...)``, and leaves models within models to pydantic."""

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
        """A model of that metaclass."""


class CheckedModel(Checked):
    """Base of models that users create: a mistake in a field is a :class:`MitsonarError` with one sentence.

    Attributes:
        called: what owns the fields, in that sentence.
        see: a page with more, for its end.
    """

    called: ClassVar[str]
    see: ClassVar[str] = ""

    @classmethod
    def refuse(cls, error: ValidationError) -> NoReturn:
        """Raise the sentence.

        Raises:
            MitsonarError: the first of pydantic's complaints.
        """
        raise MitsonarError(complaint(error, cls, cls.called, cls.see)) from None
