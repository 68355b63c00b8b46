"""Makes SDT files of Becker & Hickl by hand, after their documented headers."""

import numpy as np
import pytest


def sdt_bytes(images: np.ndarray) -> bytes:
    """An SDT file of images [n, Y, X, H], each a data block."""
    layout = pytest.importorskip("sdtfile").sdtfile
    info = b"*IDENTIFICATION\r\n  ID : SPC Setup & Data File\r\n*END\r\n"
    measured = np.zeros(1, np.dtype(layout.MEASURE_INFO).newbyteorder("<"))
    _, height, width, times = images.shape
    for name, value in (("scan_x", width), ("scan_y", height), ("scan_rx", 1), ("scan_ry", 1), ("adc_re", times)):
        measured[name] = value
    measured["tac_g"] = 1
    measured["tac_r"] = 1e-8
    header = np.zeros(1, np.dtype(layout.FILE_HEADER).newbyteorder("<"))
    block = np.zeros(1, np.dtype(layout.BLOCK_HEADER).newbyteorder("<"))
    first = header.nbytes + len(info) + measured.nbytes
    size = images[0].size * 2
    header["revision"] = 15
    header["chksum"] = 0x55AA
    header["header_valid"] = 0x5555
    header["info_offs"] = header.nbytes
    header["info_length"] = len(info)
    header["meas_desc_block_offs"] = header.nbytes + len(info)
    header["meas_desc_block_length"] = measured.nbytes
    header["no_of_meas_desc_blocks"] = 1
    header["data_block_offs"] = first
    header["no_of_data_blocks"] = len(images)
    found = header.tobytes() + info + measured.tobytes()
    for i, image in enumerate(images):
        at = first + i * (block.nbytes + size)
        block["data_offs"] = at + block.nbytes
        block["next_block_offs"] = at + block.nbytes + size
        block["block_length"] = size
        found += block.tobytes() + image.astype("<u2").tobytes()
    return found
