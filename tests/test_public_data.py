"""Data beside the clone: the reason of a skip names the data, and CI does not skip."""

import public_data
import pytest


@pytest.mark.parametrize("name", ["cloth/sock.obj", "cloth", "queries.npz"])
def test_absent_data_are_named_by_the_skip_and_missed_in_ci(name, monkeypatch, tmp_path):
    reason = f"needs ../shared/data/{name.partition('/')[0]}, which no clone contains"
    monkeypatch.setattr(public_data, "DATA", tmp_path)
    monkeypatch.delenv("CI", raising=False)
    with pytest.raises(pytest.skip.Exception, match=f"^{reason}$"):
        public_data.public(name)
    monkeypatch.setenv("CI", "true")
    with pytest.raises(AssertionError, match=reason):
        public_data.public(name)
