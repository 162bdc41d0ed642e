"""Every command of the library: its options follow from the annotations of the function that it calls."""

from __future__ import annotations

import pytest
from real2sim.__main__ import COMMANDS, main


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_options_of_a_command_can_be_told(command, capsys):
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0
    assert "--" in capsys.readouterr().out
