/* Up to 64 bits, little-endian, the first object lowest (CiA 301, 7.4.8 and 7.5.2.36). */
#include "pdo_image.h"

#include <assert.h>
#include <string.h>

int image_octets(int bits)
{
    assert(0 <= bits && bits <= PDO_BITS_MAX);
    return (bits + 7) / 8;
}

static uint64_t mask(int bits)
{
    assert(0 < bits && bits <= PDO_BITS_MAX);
    return UINT64_MAX >> (64 - bits);
}

void put_field(uint64_t *image, const ImageField *field, uint64_t raw)
{
    assert(0 <= field->shift && field->shift + field->bits <= PDO_BITS_MAX);
    *image |= (raw & mask(field->bits)) << field->shift;
}

uint64_t raw_field(uint64_t image, const ImageField *field)
{
    assert(0 <= field->shift && field->shift + field->bits <= PDO_BITS_MAX);
    return image >> field->shift & mask(field->bits);
}

bool fits_signed(int64_t value, int bits)
{
    int64_t most = (int64_t)(mask(bits) >> 1);
    return -most - 1 <= value && value <= most;
}

bool fits_unsigned(uint64_t value, int bits) { return value <= mask(bits); }

int64_t signed_value(uint64_t raw, int bits)
{
    uint64_t sign = (uint64_t)1 << (bits - 1);
    return (int64_t)((raw ^ sign) - sign); /* two's complement */
}

/* IEEE 754 binary32 or binary64 (CiA 301, 7.1.4.5). */
uint64_t raw_real(double value, int bits)
{
    uint64_t raw = 0;
    if (bits == 32) {
        float narrow = (float)value;
        uint32_t word;
        memcpy(&word, &narrow, sizeof word);
        return word;
    }
    memcpy(&raw, &value, sizeof raw);
    return raw;
}

double real_value(uint64_t raw, int bits)
{
    double value;
    if (bits == 32) {
        uint32_t word = (uint32_t)raw;
        float narrow;
        memcpy(&narrow, &word, sizeof narrow);
        return narrow;
    }
    memcpy(&value, &raw, sizeof value);
    return value;
}

void write_image(uint64_t image, unsigned char *octets, int count)
{
    for (int octet = 0; octet < count; octet++)
        octets[octet] = (unsigned char)(image >> 8 * octet);
}

uint64_t read_image(const unsigned char *octets, int count)
{
    uint64_t image = 0;
    assert(0 <= count && count <= 8);
    for (int octet = 0; octet < count; octet++)
        image |= (uint64_t)octets[octet] << 8 * octet;
    return image;
}
