/* The fields of a row are little endian on every machine. */
#include "frame_row.h"

#include <assert.h>
#include <string.h>

static void put(unsigned char *place, uint64_t value, int octets)
{
    for (int octet = 0; octet < octets; octet++)
        place[octet] = (unsigned char)(value >> 8 * octet);
}

void pack_frame(const RawFrame *frame, unsigned char *row)
{
    assert(frame->length >= 0 && frame->length <= FRAME_DATA_MAX);
    put(row, (uint64_t)frame->at, 8);
    put(row + 8, frame->can_id, 4);
    row[12] = (unsigned char)frame->length;
    row[13] = frame->sent;
    memset(row + 14, 0, FRAME_ROW_BYTES - 14);
    memcpy(row + 16, frame->data, (size_t)frame->length);
}
