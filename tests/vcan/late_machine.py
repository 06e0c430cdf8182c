"""What a bench on vcan is not judged by: the time of a machine inside another means nothing."""

from typing import Final

NO_MATTER_HOW_LATE: Final = {
    "verdict.speed_error_peak_percent_max": 100.0,
    "verdict.after_load_percent_max": 100.0,
    "verdict.dropouts_percent_max": 100.0,
}
