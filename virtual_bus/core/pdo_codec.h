/* The objects mapped into a PDO, and its octets: Python's PdoCodec. */
#ifndef CORE_PDO_CODEC_H
#define CORE_PDO_CODEC_H

#include "pdo_image.h"
#include "stable_abi.h"

typedef struct CodecObject {
    PyObject head;
    bool provided; /* a variable may have a provider, which is asked in place of its value */
    int count, variable_count, bits;
    ImageField fields[PDO_FIELDS_MAX];
    PyObject *variables[PDO_FIELDS_MAX]; /* NULL: a gap */
    uint64_t seen;                       /* image at the last look for a change */
} CodecObject;

extern PyTypeObject *codec_type;

bool sample_image(CodecObject *self, uint64_t *image);
PyObject *pack_octets(CodecObject *self);
int look_at_image(CodecObject *self);
int unpack_values(const CodecObject *self, const unsigned char *octets, PyObject **values);

#endif
