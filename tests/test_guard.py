"""Fits take the iterations, and reach the errors, that are stored; see `guard.py`."""

import guard


def test_fits_are_what_is_stored():
    old, new = guard.stored(), guard.measured()
    assert old.keys() == new.keys(), "store the new fits by `python tests/guard.py --write`"
    differing = "\n".join(guard.differences(old, new))
    assert not differing, f"\n{differing}\nif that is meant, run `python tests/guard.py --write`"
