"""multipart/form-data -> named parts, strictly: every part named, none twice, the closing boundary there."""

from __future__ import annotations

from typing import Final

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from viflow_anomaly_service.problems import Problem

MAX_PARTS: Final = 16


def parse_form(data: bytes, *, content_type: str) -> dict[str, bytes]:
    """Split a body that was read whole; file parts and plain fields are treated alike, whatever type they declare.

    Args:
        data: the body.
        content_type: the request's header, with its boundary.

    Raises:
        Problem: 400 ``multipart_invalid``, 413 ``multipart_too_many_parts``, 422 ``part_duplicated``.
    """
    _, options = parse_options_header(content_type)
    boundary = options.get(b"boundary")
    if not boundary:
        raise _invalid("expected a boundary in Content-Type, found none")
    collector = _PartCollector()
    try:
        parser = MultipartParser(
            boundary,
            {
                "on_part_begin": collector.begin_part,
                "on_header_field": collector.header_name,
                "on_header_value": collector.header_value,
                "on_header_end": collector.end_header,
                "on_part_data": collector.part_data,
                "on_part_end": collector.end_part,
                "on_end": collector.end_form,
            },
        )
        parser.write(data)
        parser.finalize()
    except FormParserError as err:
        raise _invalid(f"expected multipart/form-data, found: {err}") from err
    if not collector.ended:
        raise _invalid("expected the closing boundary, found the end of the body: the upload was cut short")
    return collector.parts


def _invalid(detail: str) -> Problem:
    return Problem(400, code="multipart_invalid", detail=detail)


class _PartCollector:
    """Callbacks of the parser; ``parts`` is complete once ``ended``."""

    def __init__(self) -> None:
        self.parts: dict[str, bytes] = {}
        self.ended = False
        self._headers: dict[bytes, bytes] = {}
        self._header = [b"", b""]
        self._content: list[bytes] = []

    def begin_part(self) -> None:
        if len(self.parts) >= MAX_PARTS:
            raise Problem(413, code="multipart_too_many_parts", detail=f"expected at most {MAX_PARTS} parts")
        self._headers, self._header, self._content = {}, [b"", b""], []

    def header_name(self, data: bytes, start: int, end: int) -> None:
        self._header[0] += data[start:end]

    def header_value(self, data: bytes, start: int, end: int) -> None:
        self._header[1] += data[start:end]

    def end_header(self) -> None:
        self._headers[self._header[0].lower()] = self._header[1]
        self._header = [b"", b""]

    def part_data(self, data: bytes, start: int, end: int) -> None:
        self._content.append(data[start:end])

    def end_part(self) -> None:
        disposition, options = parse_options_header(self._headers.get(b"content-disposition", b""))
        name = options.get(b"name", b"").decode("utf-8", errors="replace")
        if disposition != b"form-data" or not name:
            raise _invalid('expected every part to carry Content-Disposition: form-data; name="..."')
        if name in self.parts:
            raise Problem(
                422, code="part_duplicated", detail=f"expected one part {name!r:.80}, found two", field=name[:80]
            )
        self.parts[name] = b"".join(self._content)

    def end_form(self) -> None:
        self.ended = True
