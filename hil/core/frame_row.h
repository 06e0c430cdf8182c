/* A raw frame as a row, hil/rows/side_rows.py has the layout. */
#ifndef CORE_FRAME_ROW_H
#define CORE_FRAME_ROW_H

#include <stdint.h>

enum { FRAME_ROW_BYTES = 24, FRAME_DATA_MAX = 8 };

typedef struct RawFrame {
    int64_t at;
    uint32_t can_id; /* with its flags */
    uint8_t sent;
    int length;
    const char *data;
} RawFrame;

void pack_frame(const RawFrame *frame, unsigned char *row);

#endif
