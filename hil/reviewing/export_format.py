"""The formats that a recording can be written in; apart, for the command line is to answer at once."""

from enum import StrEnum


class ExportFormat(StrEnum):
    """Its name is the ending of the file."""

    CSV = "csv"
    PARQUET = "parquet"
    MF4 = "mf4"
    MAT = "mat"
    LOG = "log"
    """The frames as candump -L writes them."""
    ASC = "asc"
    BLF = "blf"
    PCAP = "pcap"
    JSONL = "jsonl"
    """The injected faults, one JSON object a line."""
