"""E57: pages with checksums, packets of packed bits, grids and clouds."""

import struct

import numpy as np
import pytest

from rangecheck.errors import InputError
from rangecheck.scan.point_cloud import PointCloud
from rangecheck.scan.readers import read_measured, read_scans
from rangecheck.scan.readers.e57 import _table, first_wrong_page, unpack_bits


def crc_pages(logical, page=1024):
    """`logical` in pages with CRC-32C, computed bit by bit."""
    out = b""
    for start in range(0, len(logical), page - 4):
        part = logical[start : start + page - 4].ljust(page - 4, b"\0")
        crc = 0xFFFFFFFF
        for byte in part:
            crc ^= byte
            for _ in range(8):
                crc = (crc >> 1) ^ (0x82F63B78 if crc & 1 else 0)
        out += part + struct.pack(">I", crc ^ 0xFFFFFFFF)
    return out


def e57(fields, records, pose="", limits=""):
    """A file of one scan; fields: (xml attributes, stream bytes) by name."""
    streams = [stream for _, stream in fields.values()]
    packet_size = -(-(6 + 2 * len(streams) + sum(map(len, streams))) // 4) * 4
    packet = struct.pack("<BBHH", 1, 0, packet_size - 1, len(streams)) + struct.pack(f"<{len(streams)}H", *map(len, streams))
    packet = (packet + b"".join(streams)).ljust(packet_size, b"\0")
    section = struct.pack("<B7xQQQ", 1, 32 + len(packet), 48 + 32, 0) + packet
    assert 48 + len(section) <= 1020, "offsets below stay within the first page"
    prototype = "".join(f"<{name} {attributes}/>" for name, (attributes, _) in fields.items())
    xml = (
        '<?xml version="1.0"?><e57Root xmlns="http://www.astm.org/COMMIT/E57/2010-e57-v1.0"><data3D><vectorChild type="Structure">'
        f'<name>s</name>{pose}{limits}<points type="CompressedVector" fileOffset="48" recordCount="{records}">'
        f"<prototype>{prototype}</prototype></points></vectorChild></data3D></e57Root>"
    ).encode()
    place = 48 + len(section)
    total = -(-(place + len(xml)) // 1020) * 1024
    header = struct.pack("<8sIIQQQQ", b"ASTM-E57", 1, 0, total, place, len(xml), 1024)
    return crc_pages(header + section + xml)


def bits(values, width):
    number = sum(int(v) << (width * k) for k, v in enumerate(values))
    return number.to_bytes(-(-width * len(values) // 8), "little")


def grid_e57(**changes):
    x, y, z = np.array([[2.0, 2, 2, 2, 2], [0.1, 0, 0.1, 0, 0.05], [0.1, 0.1, 0, 0, 0]])
    fields = {
        "cartesianX": ('type="Float" precision="single"', x.astype("<f4").tobytes()),
        "cartesianY": ('type="Float"', y.astype("<f8").tobytes()),
        "cartesianZ": ('type="ScaledInteger" minimum="-500" maximum="523" scale="0.001"', bits(np.rint(z * 1000) + 500, 10)),
        "rowIndex": ('type="Integer" minimum="0" maximum="1"', bits([0, 0, 1, 1, 1], 1)),
        "columnIndex": ('type="Integer" minimum="0" maximum="1"', bits([0, 1, 0, 1, 1], 1)),
        "cartesianInvalidState": ('type="Integer" minimum="0" maximum="2"', bits([0, 0, 0, 0, 2], 2)),
        "intensity": ('type="Integer" minimum="7" maximum="7"', b""),
    } | changes
    pose = "<pose><rotation><w>0</w><x>0</x><y>0</y><z>1</z></rotation><translation><x>1</x></translation></pose>"
    return e57(fields, 5, pose)


def test_an_e57_with_indices_is_a_grid_in_metres_at_its_pose(tmp_path):
    (tmp_path / "a.e57").write_bytes(grid_e57())
    (scan,) = read_scans(tmp_path / "a.e57")
    assert scan.range_mm.shape == (2, 2) and scan.valid.all() and scan.unit == "m" and scan.name == "s"
    # half a turn about z, then one metre along x
    told = [[-1000, -100, 100], [-1000, 0, 100], [-1000, -100, 0], [-1000, 0, 0]]
    assert np.allclose(sorted(scan.points_mm().round(3).tolist()), sorted(told), atol=1e-3)


def test_an_e57_without_indices_is_a_cloud(tmp_path):
    (tmp_path / "a.e57").write_bytes(grid_e57(rowIndex=('type="String"', b""), columnIndex=('type="String"', b"")))
    (cloud,) = read_measured(tmp_path / "a.e57")
    assert isinstance(cloud, PointCloud) and len(cloud.points_mm) == 4


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda b: b[:-1024], "copy it again"),
        (lambda b: b[:100] + bytes([b[100] ^ 1]) + b[101:], "page 0 of . has a wrong checksum"),
        (lambda b: b[:20], "cut short"),
        (lambda b: repage(b, b'recordCount="5"', b'recordCount="9"'), "cut short"),
        (lambda b: repage(b, b'fileOffset="48"', b'fileOffset="99"'), "section of kind"),
        (lambda b: repage(b, b'fileOffset="48"', b'fileOffset="-9"'), "section|cut short|cannot"),
        (lambda b: repage(b, b'minimum="-500"', b'minimum="9999"'), "cartesianZ runs from"),
        (lambda b: repage(b, b"cartesianX", b"cartesianU"), "neither Cartesian nor spherical"),
        (lambda b: repage(b, b"<prototype>", b"<prototypo>"), "XML is damaged"),
        (lambda b: repage(b, b'<?xml version="1.0"?>', b"<!DOCTYPE e57Root   >"), "declares entities"),
        (lambda b: repage(b, b"<w>0</w><x>0</x><y>0</y><z>1</z>", b"<w>0</w><x>0</x><y>0</y><z>0</z>"), "no rigid motion"),
    ],
)
def test_a_damaged_e57_is_refused(tmp_path, change, message):
    (tmp_path / "a.e57").write_bytes(change(grid_e57()))
    with pytest.raises(InputError, match=message):
        read_scans(tmp_path / "a.e57")


def repage(content, old, new):
    """Change the content and put the checksums right again."""
    logical = b"".join(content[k : k + 1020] for k in range(0, len(content), 1024))
    assert old in logical and len(old) == len(new)
    return crc_pages(logical.replace(old, new))


def test_bits_of_every_width_are_unpacked():
    random = np.random.default_rng(0)
    for width in (1, 3, 7, 8, 13, 31, 32, 47, 63, 64):
        values = (
            random.integers(0, 2**width, 17, dtype=np.uint64, endpoint=False)
            if width < 64
            else random.integers(0, 2**63, 17, np.uint64)
        )
        found = unpack_bits(np.frombuffer(bits(values, width), np.uint8), width, 17)
        assert (found == values).all()


def test_the_checksum_of_a_known_page_is_known():
    # CRC-32C of "123456789" is E3069283 (RFC 3720, Castagnoli)
    page = np.frombuffer(b"123456789" + bytes.fromhex("E3069283"), np.uint8)
    assert first_wrong_page(page, 13, _table()) == -1


@pytest.mark.real_data
def test_the_good_e57_is_read_as_another_library_reads_it_and_the_bad_one_refused(real_data):
    path = real_data / "e57" / "reference_bunnyInt32.e57"
    (cloud,) = read_measured(path)
    assert cloud.points_mm.shape == (30571, 3)
    pye57 = pytest.importorskip("pye57")
    other = pye57.E57(str(path)).read_scan_raw(0)
    assert (cloud.points_mm == 1000 * np.stack([other[f"cartesian{axis}"] for axis in "XYZ"], axis=1)).all()
    with pytest.raises(InputError, match="page 0 of 1 has a wrong checksum"):
        read_measured(real_data / "e57" / "self_bad-crc.e57")
