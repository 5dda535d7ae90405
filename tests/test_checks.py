"""Names in the messages of checks, also of errors that others raise."""

from __future__ import annotations

import json

import pytest

from torchrl_etl.checks import naming, renaming


def test_errors_with_other_arguments_keep_their_class():
    with pytest.raises(json.JSONDecodeError, match=r"^method\.Expecting value"), naming("method"):
        json.loads("")
    with pytest.raises(UnicodeDecodeError, match="invalid start byte"), naming("method"):
        b"\xff".decode()
    with pytest.raises(UnicodeDecodeError, match="invalid start byte"), renaming(share="relabel"):
        b"\xff".decode()
