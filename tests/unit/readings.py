"""Codes of a reading's findings, and the refusal of a file."""

from __future__ import annotations

import pytest
from real2sim.errors import InputError


def codes(recording):
    """Codes of the findings, in their order."""
    return [finding.code for finding in recording.findings]


def refusal(reader, path):
    """Error with which a reader refuses a file; it names the file and a remedy."""
    with pytest.raises(InputError) as error:
        reader(path)
    assert path.name in str(error.value)
    assert error.value.remedy
    return error.value
