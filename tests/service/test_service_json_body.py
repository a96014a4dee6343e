from __future__ import annotations

import math

import pytest

from viflow_anomaly_service.json_body import MAX_DEPTH, parse_json
from viflow_anomaly_service.problems import Problem


def parse(text: str | bytes, *, max_values: int = 1000, part: str | None = None) -> object:
    return parse_json(text.encode() if isinstance(text, str) else text, max_values=max_values, part=part)


def test_values_arrive_as_written() -> None:
    assert parse('{"a": [1, -2.5, true, null, "ü"], "b": {}}') == {"a": [1, -2.5, True, None, "ü"], "b": {}}
    assert parse("9223372036854775807") == 2**63 - 1


def test_numbers_no_field_can_hold_arrive_as_floats_for_the_field_to_refuse() -> None:
    assert parse("1" + "0" * 30) == 1e30
    assert parse("1" + "0" * 5000) == math.inf
    assert parse("-Infinity") == -math.inf
    assert parse("1e999") == math.inf
    value = parse("NaN")
    assert isinstance(value, float)
    assert math.isnan(value)


@pytest.mark.parametrize("opening", ["[", '{"a":'])
def test_depth_limit_is_exact(opening: str) -> None:
    closing = "]" if opening == "[" else "}"
    inner = opening + closing if opening == "[" else "{}"
    parse(opening * (MAX_DEPTH - 1) + inner + closing * (MAX_DEPTH - 1))
    with pytest.raises(Problem) as caught:
        parse(opening * MAX_DEPTH + inner + closing * MAX_DEPTH)
    assert (caught.value.status, caught.value.code) == (400, "json_too_deep")


def test_value_limit_counts_before_parsing() -> None:
    assert parse("[1,2,3]", max_values=3) == [1, 2, 3]
    with pytest.raises(Problem) as caught:
        parse("[1,2,3,4", max_values=3, part="imu")
    assert (caught.value.status, caught.value.code, caught.value.field) == (413, "json_too_many_values", "imu")


@pytest.mark.parametrize("text", ["", "nul", "{'a': 1}", '{"a": 1,}', "[1] [2]", '"\x01"', b'"\xc3"', b'\x00\x00\x00"'])
def test_not_json(text: str | bytes) -> None:
    with pytest.raises(Problem) as caught:
        parse(text, part="request")
    assert (caught.value.status, caught.value.code, caught.value.field) == (400, "json_invalid", "request")


@pytest.mark.parametrize("text", ['{"a":1,"b":2,"a":1}', '[{"x":{"a":1,"a":2}}]', '{"a":1,"\\u0061":2}'])
def test_duplicate_keys_at_any_depth(text: str) -> None:
    with pytest.raises(Problem) as caught:
        parse(text)
    assert (caught.value.status, caught.value.code, caught.value.field) == (422, "json_duplicate_key", "a")
