from __future__ import annotations

import pytest

from viflow_anomaly_service.form_body import MAX_PARTS, parse_form
from viflow_anomaly_service.problems import Problem

TYPE = "multipart/form-data; boundary=XX"


def part(name: str, content: bytes = b"1") -> bytes:
    return b'--XX\r\nContent-Disposition: form-data; name="%s"\r\n\r\n%s\r\n' % (name.encode(), content)


END = b"--XX--\r\n"


def test_parts_are_returned_byte_for_byte() -> None:
    data = bytes(range(256)) * 3 + b"\r\n--X \r\n--XY"
    body = part("a", data) + part("b", b"") + END
    assert parse_form(body, content_type=TYPE) == {"a": data, "b": b""}


def test_preamble_headers_in_any_case_file_names_and_utf8_names() -> None:
    body = (
        b'--XX\r\ncontent-type: image/png\r\nCONTENT-DISPOSITION: form-data; name="s"; filename="x"\r\n\r\nA\r\n'
        + part("ü", b"B")
        + END
    )
    assert parse_form(body, content_type='multipart/form-data; boundary="XX"') == {"s": b"A", "ü": b"B"}


@pytest.mark.parametrize(
    ("body", "content_type"),
    [
        pytest.param(part("a") + END, "multipart/form-data", id="no boundary named"),
        pytest.param(part("a") + END, "multipart/form-data; boundary=", id="empty boundary"),
        pytest.param(part("a") + END, "multipart/form-data; boundary=" + "y" * 500, id="boundary too long"),
        pytest.param(part("a") + END, "multipart/form-data; boundary=YY", id="another boundary"),
        pytest.param(b"", TYPE, id="empty body"),
        pytest.param(b"hello", TYPE, id="no multipart at all"),
        pytest.param(part("a"), TYPE, id="no closing boundary"),
        pytest.param(part("a")[:30], TYPE, id="cut in a header"),
        pytest.param((part("a") + END)[:-4], TYPE, id="cut in the closing boundary"),
        pytest.param(b"--XX\r\n\r\n1\r\n" + END, TYPE, id="part without headers"),
        pytest.param(b'--XX\r\nContent-Disposition: inline; name="a"\r\n\r\n1\r\n' + END, TYPE, id="not form-data"),
        pytest.param(b"--XX\r\nContent-Disposition: form-data\r\n\r\n1\r\n" + END, TYPE, id="part without a name"),
        pytest.param(b"--XX\r\nBroken header\r\n\r\n1\r\n" + END, TYPE, id="header without colon"),
        pytest.param(b"--XX\r\nX: " + b"y" * 100_000 + b"\r\n\r\n1\r\n" + END, TYPE, id="giant header"),
    ],
)
def test_broken_forms(body: bytes, content_type: str) -> None:
    with pytest.raises(Problem) as caught:
        parse_form(body, content_type=content_type)
    assert (caught.value.status, caught.value.code) == (400, "multipart_invalid")


def test_a_part_twice() -> None:
    with pytest.raises(Problem) as caught:
        parse_form(part("a") + part("a") + END, content_type=TYPE)
    assert (caught.value.status, caught.value.code, caught.value.field) == (422, "part_duplicated", "a")


def test_too_many_parts() -> None:
    names = [f"n{index}" for index in range(MAX_PARTS + 1)]
    assert len(parse_form(b"".join(map(part, names[:-1])) + END, content_type=TYPE)) == MAX_PARTS
    with pytest.raises(Problem) as caught:
        parse_form(b"".join(map(part, names)) + END, content_type=TYPE)
    assert (caught.value.status, caught.value.code) == (413, "multipart_too_many_parts")
