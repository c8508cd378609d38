"""The task of the key and the door: solved, played and drawn."""

import pytest


def test_the_example_draws_a_task(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    from examples.formulating import key_and_door

    key_and_door.main(["--output", str(tmp_path / "plan.png")])
    assert "ends at D" in capsys.readouterr().out
    assert (tmp_path / "plan.png").stat().st_size > 10_000
