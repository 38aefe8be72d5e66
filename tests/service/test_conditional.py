"""Ranges and entity tags by the letter of RFC 9110."""

from __future__ import annotations

import pytest
from fastapi import Request

from service.conditional import content, etag, unchanged
from service.problems import Problem

DATA = bytes(range(100))
TAG = etag(7)


def request(**headers: str) -> Request:
    raw = [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()]
    return Request({"type": "http", "headers": raw})


@pytest.mark.parametrize(
    ("header", "span"),
    [
        ("bytes=0-0", (0, 0)),
        ("bytes=10-19", (10, 19)),
        ("bytes=90-", (90, 99)),
        ("bytes=90-1000", (90, 99)),
        ("bytes=-10", (90, 99)),
        ("bytes=-1000", (0, 99)),
        ("bytes= 5 - 6", (5, 6)),
    ],
)
def test_range(header: str, span: tuple[int, int]) -> None:
    answer = content(request(range=header), DATA, "image/png", TAG, {})
    assert answer.status_code == 206
    assert answer.body == DATA[span[0] : span[1] + 1]
    assert answer.headers["Content-Range"] == f"bytes {span[0]}-{span[1]}/100"
    assert answer.headers["ETag"] == TAG


@pytest.mark.parametrize("header", ["bytes=1-2,4-5", "bytes=5-2", "bytes=-", "lines=1-2", "bytes=a-b", "bytes=1", ""])
def test_what_is_no_single_range_gets_the_whole(header: str) -> None:
    answer = content(request(range=header), DATA, "image/png", TAG, {})
    assert (answer.status_code, answer.body) == (200, DATA)
    assert answer.headers["Accept-Ranges"] == "bytes"


@pytest.mark.parametrize("header", ["bytes=100-", "bytes=100-200", "bytes=-0"])
def test_range_behind_the_end(header: str) -> None:
    with pytest.raises(Problem) as caught:
        content(request(range=header), DATA, "image/png", TAG, {})
    assert caught.value.status_code == 416
    assert caught.value.response().headers["Content-Range"] == "bytes */100"


def test_if_range() -> None:
    assert content(request(range="bytes=0-9", if_range=TAG), DATA, "image/png", TAG, {}).status_code == 206
    assert content(request(range="bytes=0-9", if_range='"6"'), DATA, "image/png", TAG, {}).status_code == 200


@pytest.mark.parametrize("known", [TAG, f"W/{TAG}", f'"1", {TAG}', "*"])
def test_unchanged(known: str) -> None:
    answer = unchanged(request(if_none_match=known), TAG)
    assert answer is not None
    assert (answer.status_code, answer.headers["ETag"], answer.body) == (304, TAG, b"")


@pytest.mark.parametrize("known", ['"6"', "7", '"77"', ""])
def test_changed(known: str) -> None:
    assert unchanged(request(if_none_match=known), TAG) is None
    assert unchanged(request(), TAG) is None
