"""Advice of failed registrations."""

import pytest
import shapes
from wording import check_text

from pcbench.errors import RegistrationError
from pcbench.registration import FeatureSettings, IcpSettings, advice, from_features, register

CITY = shapes.city(2000, seed=1)[0]


def failure_message(candidate, method):
    with pytest.raises(RegistrationError) as caught:
        register(CITY, candidate, method)
    return str(caught.value)


@pytest.mark.parametrize("method", [IcpSettings(), "none"], ids=["icp", "none"])
@pytest.mark.parametrize("factor", [1, 1000], ids=["far", "another unit"])
def test_a_method_that_is_not_installed_is_recommended_with_its_package(monkeypatch, method, factor):
    monkeypatch.setattr(advice, "has_global", lambda: True)
    assert "pip install" not in failure_message(factor * CITY + 1e6, method)
    monkeypatch.setattr(advice, "has_global", lambda: False)
    text = failure_message(factor * CITY + 1e6, method)
    assert "pip install 'pcbench[global]'" in check_text(text)
    assert text.count("--register global-similarity") == (factor != 1)


@pytest.mark.parametrize("with_scale", [False, True])
def test_no_method_recommends_itself(monkeypatch, with_scale):
    monkeypatch.setattr(from_features._PoseSearch, "search", lambda _: [])
    text = failure_message(CITY, FeatureSettings(with_scale=with_scale))
    assert ("global-similarity" in text) is not with_scale
    assert "points:FILE" in text
