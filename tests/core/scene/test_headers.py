"""Files of numbers are refused where one of them is none: Mitsuba would take it, and the image be black."""

from __future__ import annotations

from pathlib import Path

import pytest

from .conftest import SQUARE, Reject, load, scene_xml

LAMP = '<emitter type="constant"><spectrum name="radiance" filename="a.spd"/></emitter>'


@pytest.mark.parametrize("bad", ["500 nan", "500 NaN", "500 -inf", "inf 1", "500\tInfinity", "500 1 nan # of glass"])
def test_a_spectrum_of_numbers_that_are_none_is_refused(bad: str, tmp_path: Path, reject: Reject) -> None:
    data = f"400 1\n{bad}\n700 1\n".encode()
    message = reject(load, tmp_path, scene_xml(SQUARE, light=LAMP), {"a.spd": data})
    assert "'a.spd' has numbers that are not finite" in message


@pytest.mark.parametrize("line", ["# nan", "# inf in the first column", "", "500 1 # nan"])
def test_words_in_comments_are_no_numbers(line: str, tmp_path: Path) -> None:
    data = f"# information\n400 1\n{line}\n600 1\n".encode()
    assert load(tmp_path, scene_xml(SQUARE, light=LAMP), {"a.spd": data}).summary.emitters[0].count == 1
