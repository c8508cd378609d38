"""A refusal in one line."""

import pytest

from ssp_lp import ModelError


def refused(message, call, *arguments, error=ModelError, **options):
    """The text of the error with these words that the call raises."""
    with pytest.raises(error, match=message) as caught:
        call(*arguments, **options)
    return str(caught.value)
