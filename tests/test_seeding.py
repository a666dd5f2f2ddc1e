"""Seeds by purpose."""

from franka_wm.seeding import derive_seed


def test_the_same_purpose_and_seed_give_the_same_number_in_every_process():
    assert derive_seed("evaluation", 0) == 1277629110


def test_purposes_seeds_and_parts_are_told_apart():
    asked = [
        (p, s, *more) for p in ("a", "b") for s in range(50) for more in ((), (1,), ("1x",), (1, 2), (12,))
    ]
    assert len({derive_seed(*one) for one in asked}) == len(asked)


def test_every_seed_fits_into_31_bits():
    seeds = [derive_seed("training", seed) for seed in range(1000)]
    assert all(0 <= seed < 2**31 for seed in seeds)
    every = 0
    for seed in seeds:
        every |= seed
    assert every == 2**31 - 1  # and every bit is used
