/* The length of a classical CAN frame on the wire, with all stuff bits.

   ISO 11898-1 (in Bosch's CAN 2.0, part B: 3.2.1 and 3.2.2 frames and CRC sequence with the polynomial 0x4599,
   6 bit stuffing: from start of frame to the end of the CRC sequence a bit of opposite value after five equal
   ones, itself counted towards the next five). */
#include "wire_bits.h"

#include <assert.h>
#include <stdbool.h>

enum {
    TAIL_BITS = 10, /* CRC delimiter, ACK slot, ACK delimiter and seven bits of end of frame: never stuffed */
    CRC_BITS = 15,
    STANDARD_HEAD_BITS = 19, /* start of frame, identifier, RTR, IDE, r0, DLC */
    EXTENDED_HEAD_BITS = 39, /* start of frame, base, SRR, IDE, extension, RTR, r1, r0, DLC */
};

/* What the eight bits that leave the CRC register, combined with a byte, leave in it. */
static uint16_t crc_table[256];
/* [state][next byte]: next state | stuff bits in between << 3. A state is (length of the run of equal bits - 1)
   << 1 | their value; a run of five ends in its stuff bit, so that lengths are 1 to 4. */
static uint8_t stuffing_table[8][256];

static uint16_t crc_of(int byte)
{
    unsigned crc = (unsigned)byte << 7;
    for (int bit = 0; bit < 8; bit++)
        crc = (crc & 0x4000 ? crc << 1 ^ 0x4599 : crc << 1) & 0x7FFF;
    return (uint16_t)crc;
}

static uint8_t stuffing_of(int state, int byte)
{
    int run = (state >> 1) + 1, last = state & 1, stuffed = 0;
    for (int position = 7; position >= 0; position--) {
        int bit = byte >> position & 1;
        run = bit == last ? run + 1 : 1;
        last = bit;
        if (run == 5) {
            run = 1;
            last = 1 - bit;
            stuffed++;
        }
    }
    return (uint8_t)((run - 1) << 1 | last | stuffed << 3);
}

/* Once, before the first frame. */
void make_wire_tables(void)
{
    for (int byte = 0; byte < 256; byte++) {
        crc_table[byte] = crc_of(byte);
        for (int state = 0; state < 8; state++)
            stuffing_table[state][byte] = stuffing_of(state, byte);
    }
}

typedef struct Bits {
    unsigned crc, state;
    int stuffed;
} Bits;

static void take(Bits *bits, unsigned byte, unsigned filling)
{
    assert(bits->state < 8 && byte < 256 && bits->crc < 1U << CRC_BITS);
    unsigned step = stuffing_table[bits->state][byte | filling];
    bits->crc = (bits->crc << 8 & 0x7FFF) ^ crc_table[bits->crc >> 7 ^ byte];
    bits->state = step & 7;
    bits->stuffed += (int)(step >> 3);
}

/* Bits from start of frame to end of frame. `field`: the arbitration field as a number, its bits in their order
   on the wire, and below it the four bits of the DLC; `data`: `length` octets, as many as the DLC says or, of a
   remote frame, none.

   Whole bytes pass through the tables. The head is filled up in front: with zeros for the CRC, which leading
   zeros do not change; with alternating bits for the stuffing, which end in the recessive level of the idle bus
   and never make a run. */
int wire_bits(uint64_t field, const unsigned char *data, int length)
{
    bool extended = field >> 23 & 1;
    unsigned dlc = field & 0xF;
    uint64_t head = extended ? field >> 4 << 6 | dlc : field >> 23 << 5 | dlc;
    unsigned filling = extended ? 0x80 : 0xA8;
    Bits bits = {0};
    for (int shift = extended ? 32 : 16; shift >= 0; shift -= 8) {
        take(&bits, head >> shift & 0xFF, filling);
        filling = 0;
    }
    for (int place = 0; place < length; place++)
        take(&bits, data[place], 0);
    /* The CRC is filled up to two bytes behind, with a bit that makes no run. */
    unsigned tail = bits.crc << 1 | (~bits.crc & 1);
    take(&bits, tail >> 8, 0);
    take(&bits, tail & 0xFF, 0);
    return (extended ? EXTENDED_HEAD_BITS : STANDARD_HEAD_BITS) + 8 * length + CRC_BITS + bits.stuffed + TAIL_BITS;
}
