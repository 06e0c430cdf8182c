/* The octets of a PDO as one number, and the objects mapped into it. */
#ifndef CORE_PDO_IMAGE_H
#define CORE_PDO_IMAGE_H

#include <stdbool.h>
#include <stdint.h>

enum {
    /* CiA 301, 7.5.2.36: a mapping has up to 64 entries, of a bit at least. */
    PDO_BITS_MAX = 64,
    PDO_FIELDS_MAX = 64,
};

typedef enum FieldKind { GAP, UNSIGNED, SIGNED, REAL } FieldKind;

typedef struct ImageField {
    FieldKind kind;
    int bits, shift;
} ImageField;

int image_octets(int bits);
void put_field(uint64_t *image, const ImageField *field, uint64_t raw);
uint64_t raw_field(uint64_t image, const ImageField *field);
bool fits_signed(int64_t value, int bits);
bool fits_unsigned(uint64_t value, int bits);
int64_t signed_value(uint64_t raw, int bits);
uint64_t raw_real(double value, int bits);
double real_value(uint64_t raw, int bits);
void write_image(uint64_t image, unsigned char *octets, int count);
uint64_t read_image(const unsigned char *octets, int count);

#endif
