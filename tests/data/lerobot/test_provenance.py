"""Whether a recording was made in the same environment, from what it says of that."""

from franka_wm.data.lerobot.provenance import other_option


def test_a_recording_from_before_an_option_had_what_it_does_by_itself() -> None:
    now = {"task": "push", "disc_radius": 0.1, "disc_spread": 0.09}
    assert other_option([{"config": {"env": {"task": "push"}}}], now) == ("disc_spread", 0.0)
    assert other_option([{"config": {"env": now}}], now) is None
    assert other_option([{"config": {"env": now}}], {**now, "disc_radius": 0.05}) == ("disc_radius", 0.1)
    assert other_option([{}], now) is None, "nothing is known of how it was recorded"
