#ifndef CORE_WIRE_BITS_H
#define CORE_WIRE_BITS_H

#include <stdint.h>

void make_wire_tables(void);
int wire_bits(uint64_t field, const unsigned char *data, int length);

#endif
