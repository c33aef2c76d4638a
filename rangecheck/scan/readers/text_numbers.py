"""Numbers in text files, at the speed of the disk: one compiled pass, correctly rounded.

A decimal of at most 2^53 times a power of ten up to 22 is exact in one multiplication or division (Clinger, "How to read
floating point numbers accurately", PLDI 1990); the few others go through Python's own conversion. Windows spellings of NaN count
as NaN. A decimal comma is accepted where the file can mean nothing else.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.errors import InputError
from rangecheck.kernels import kernel

_POWERS = 10.0 ** np.arange(23)
_MAX_HARD = 4_000_000
_SPACE, _NEWLINE, _DOT, _COMMA, _SEMICOLON = b" \n.,;"
_NAN_WORDS = (
    "nan",
    "-nan",
    "+nan",
    "nan(ind)",
    "-nan(ind)",
    "nan(snan)",
    "-nan(snan)",
    "1.#ind",
    "-1.#ind",
    "1.#qnan",
    "-1.#qnan",
)


@kernel
def _scan(text, position, decimal, separator, columns, powers, out, hard):
    """Numbers of `text` from `position` into `out`; tokens that need more care into `hard` (index, start, end).

    Returns count, hard count, position reached, line position with a wrong number of columns or -1."""
    count, n_hard, in_line, line_start = 0, 0, 0, position
    size = text.size
    while count < out.size and n_hard < len(hard):
        while position < size:
            c = int(text[position])
            if c == 10:
                if columns > 0 and in_line > 0 and in_line != columns:
                    return count, n_hard, position, line_start
                in_line = 0
                line_start = position + 1
            elif not (c == 32 or (9 <= c <= 13) or c == separator):
                break
            position += 1
        if position >= size:
            break
        start = position
        negative = text[position] == 45
        if negative or text[position] == 43:
            position += 1
        mantissa, digits, exponent, plain = np.uint64(0), 0, 0, True
        seen, after_point = False, False
        while position < size:
            c = int(text[position])
            if 48 <= c <= 57:
                seen = True
                if digits < 19:
                    mantissa = mantissa * np.uint64(10) + np.uint64(c - 48)
                    if mantissa > 0:
                        digits += 1
                    if after_point:
                        exponent -= 1
                else:
                    plain = False
            elif c == decimal and not after_point:
                after_point = True
            else:
                break
            position += 1
        if seen and position < size and (text[position] | 32) == 101:
            position += 1
            down = position < size and text[position] == 45
            if position < size and (down or text[position] == 43):
                position += 1
            power, any_digit = 0, False
            while position < size and 48 <= text[position] <= 57:
                any_digit = True
                if power < 10000:
                    power = power * 10 + (int(text[position]) - 48)
                position += 1
            plain = plain and any_digit
            exponent += -power if down else power
        ended = position >= size or text[position] == 32 or 9 <= text[position] <= 13 or text[position] == separator
        if ended and seen and plain and mantissa <= np.uint64(9007199254740992) and -22 <= exponent <= 22:
            value = float(mantissa)
            value = value / powers[-exponent] if exponent < 0 else value * powers[exponent]
            out[count] = -value if negative else value
        else:
            while position < size and not (text[position] == 32 or 9 <= text[position] <= 13 or text[position] == separator):
                position += 1
            hard[n_hard, 0], hard[n_hard, 1], hard[n_hard, 2] = count, start, position
            n_hard += 1
        count += 1
        in_line += 1
    wrong = line_start if columns > 0 and in_line > 0 and in_line != columns and position >= size else -1
    return count, n_hard, position, wrong


def parse_numbers(
    path: Path, text: bytes, start: int = 0, count: int | None = None, *, columns: int = 0, what: str = "numbers"
) -> tuple[FloatArray, int]:
    """The next `count` numbers (None: all) of `text` from byte `start`, float64, and the byte where reading ended.

    columns  refuse lines that hold numbers but not this many; 0: line ends do not matter
    what     for the message when too few are there

    Raises InputError with the line of the first token that is no number."""
    decimal, separator = punctuation(path, text, start)
    size = len(text) - start
    most = (size + 1) // 2 + 1  # one more than fit, so that the last line end is seen too
    room = most if count is None else min(count, most)
    out = np.empty(room)
    hard = np.empty((min(room, _MAX_HARD) + 1, 3), np.int64)
    data = np.frombuffer(text, np.uint8)
    found, n_hard, end, wrong = _scan(data, start, decimal, separator, columns, _POWERS, out, hard)
    for index, first, last in hard[:n_hard].tolist():
        out[index] = _careful(path, text, first, last, chr(decimal))
    if wrong >= 0:
        here = len(text[wrong:].split(b"\n", 1)[0].replace(bytes([separator]), b" ").split())
        raise InputError(path, f"line {_line(text, wrong)} holds {here} numbers and {columns} are needed; correct that line")
    if n_hard > _MAX_HARD:
        raise InputError(path, f"holds more than {_MAX_HARD} numbers of over 15 digits; write floats with at most 15")
    if count is not None and found < count:
        raise InputError(
            path, f"is cut short: {found} of {count} {what} are there; copy or export it again", found=found, wanted=count
        )
    return out[:found], end


def plain_text(content: bytes) -> bytes:
    """Text without the mark that some programs put before UTF-8, and with line feeds where its lines end by carriage returns alone."""
    content = content.removeprefix(b"\xef\xbb\xbf")
    return content.replace(b"\r", b"\n") if b"\r" in content and b"\n" not in content else content


def _careful(path: Path, text: bytes, first: int, last: int, decimal: str) -> float:
    token = text[first : min(last, first + 400)]
    try:
        word = token.decode("ascii")
        if word.lower() in _NAN_WORDS:
            return float("nan")
        if "_" in word:
            raise ValueError
        return float(word.replace(decimal, "."))
    except ValueError:
        raise InputError(path, f"line {_line(text, first)} holds {token[:24]!r} where a number is needed") from None


def _line(text: bytes, position: int) -> int:
    return text.count(b"\n", 0, position) + 1


def punctuation(path: Path, text: bytes, start: int) -> tuple[int, int]:
    """Decimal mark and separator besides white space. A comma is the decimal mark when the file has no point, and each comma
    stands alone between digits of one word; else it separates; `1.234,5` with both in one number is refused."""
    if text.find(b",", start) < 0:
        return _DOT, _SEMICOLON if text.find(b";", start) >= 0 else _SPACE
    points = text.find(b".", start) >= 0
    semicolons = text.find(b";", start) >= 0
    if semicolons and points:
        raise InputError(path, "mixes commas, points and semicolons; write numbers with points, separated by spaces")
    words = text[start : start + 65536].replace(b";", b" ").split()
    decimal = not points and all(w.count(b",") <= 1 and not w.startswith(b",") and not w.endswith(b",") for w in words[:-1])
    decimal = decimal and (semicolons or len(words) > 1)
    if decimal:
        return _COMMA, _SEMICOLON if semicolons else _SPACE
    if semicolons:
        raise InputError(path, "mixes commas and semicolons; write numbers with points, separated by spaces")
    lines = text[start : start + 65536].split(b"\n")
    for line in lines if len(text) <= start + 65536 else lines[:-1]:
        fields = line.split(b",")
        if any(len(f.split()) > 1 for f in fields):
            raise InputError(path, f"mixes commas and spaces between numbers ({line[:40]!r}); separate them by one of the two")
    return _DOT, _COMMA
