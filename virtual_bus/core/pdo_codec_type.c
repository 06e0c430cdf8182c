/* Python's PdoCodec (native.pyi). */
#include <assert.h>

#include "attributes.h"
#include "pdo_codec.h"
#include "types.h"

PyTypeObject *codec_type;

static CodecObject *codec_of(PyObject *self) { return (CodecObject *)self; }

/* A variable, or None for a gap, its bits, and the kind of its numbers. */
static bool add_field(CodecObject *self, PyObject *triple)
{
    int64_t bits, kind;
    if (!is_a(triple, &PyTuple_Type, "a tuple") || !takes(PyTuple_Size(triple), 3, "a field"))
        return false;
    PyObject *variable = PyTuple_GetItem(triple, 0);
    if (!integer(PyTuple_GetItem(triple, 1), &bits) || !integer(PyTuple_GetItem(triple, 2), &kind))
        return false;
    bool wide = kind != REAL || bits == 32 || bits == 64;
    if (bits < 1 || kind < GAP || kind > REAL || !wide || self->bits + bits > PDO_BITS_MAX
        || self->count >= PDO_FIELDS_MAX) {
        PyErr_Format(PyExc_ValueError, "a field of %lld bits and kind %lld behind %d bits: at most %d in all expected",
                     (long long)bits, (long long)kind, self->bits, PDO_BITS_MAX);
        return false;
    }
    self->fields[self->count] = (ImageField){(FieldKind)kind, (int)bits, self->bits};
    if (kind != GAP) {
        self->variables[self->count] = another(variable);
        self->variable_count++;
    }
    self->count++;
    self->bits += (int)bits;
    return true;
}

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)names;
    if (!takes(PyTuple_Size(arguments), 2, "PdoCodec"))
        return NULL;
    PyObject *fields = PySequence_Tuple(PyTuple_GetItem(arguments, 0));
    int provided = PyObject_IsTrue(PyTuple_GetItem(arguments, 1));
    PyObject *self = fields == NULL || provided < 0 ? NULL : PyType_GenericAlloc(type, 0);
    bool well = self != NULL;
    for (Py_ssize_t place = 0; well && place < PyTuple_Size(fields); place++)
        well = add_field(codec_of(self), PyTuple_GetItem(fields, place));
    forget(&fields);
    if (well)
        codec_of(self)->provided = provided != 0;
    else
        forget(&self);
    return self;
}

static int visit_codec(PyObject *self, visitproc visit, void *argument)
{
    int result = visit((PyObject *)self->type, argument);
    for (int place = 0; result == 0 && place < codec_of(self)->count; place++)
        result = visit_one(codec_of(self)->variables[place], visit, argument);
    return result;
}

/* What is left has no variable: its fields are gaps. */
static int clear_codec(PyObject *self)
{
    CodecObject *codec = codec_of(self);
    codec->variable_count = 0;
    for (int place = 0; place < codec->count; place++) {
        codec->fields[place].kind = GAP;
        forget(&codec->variables[place]);
    }
    return 0;
}

static void discard(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    clear_codec(self);
    end_object(self);
}

static bool raw_whole(int64_t value, const ImageField *field, uint64_t *raw)
{
    int bits = 8 * image_octets(field->bits); /* a number is held in whole octets */
    *raw = (uint64_t)value;
    bool fits = field->kind == SIGNED ? fits_signed(value, bits) : value >= 0 && fits_unsigned(*raw, bits);
    if (!fits)
        PyErr_Format(PyExc_ValueError, "a value that %d bits do not hold: %lld", field->bits, (long long)value);
    return fits;
}

static bool raw_of(PyObject *value, const ImageField *field, uint64_t *raw)
{
    int64_t whole_number;
    double real;
    if (field->kind == UNSIGNED && field->bits > 56) {
        *raw = PyLong_AsUnsignedLongLong(value);
        return *raw != UINT64_MAX || !PyErr_Occurred();
    }
    if (field->kind != REAL)
        return integer(value, &whole_number) && raw_whole(whole_number, field, raw);
    if (!number(value, &real))
        return false;
    *raw = raw_real(real, field->bits);
    double held = real_value(*raw, field->bits);
    bool fits = held - held == 0.0 || real - real != 0.0; /* finite, or never was */
    if (!fits)
        PyErr_Format(PyExc_ValueError, "a value that %d bits do not hold", field->bits);
    return fits;
}

/* What a provider gives; a number of the drive's loops or clock becomes no object. */
static bool raw_given(PyObject *provider, const ImageField *field, uint64_t *raw)
{
    int64_t told;
    int tells = field->kind == REAL ? 0 : tell_number(provider, &told);
    if (tells == 0 && field->kind != REAL)
        tells = tell_clock(provider, &told);
    if (tells)
        return tells > 0 && raw_whole(told, field, raw);
    PyObject *given = PyObject_Vectorcall(provider, NULL, 0, NULL);
    bool well = given != NULL && raw_of(given, field, raw);
    forget(&given);
    return well;
}

/* Of a variable that is held: what is called may change the codec. */
static bool raw_now(bool provided, PyObject *variable, const ImageField *field, uint64_t *raw)
{
    static Attribute value = {.spelt = "value"}, provider = {.spelt = "provider"};
    PyObject *asked = provided ? attribute(&provider, variable) : NULL;
    if (provided && asked == NULL)
        return false;
    bool well;
    if (is_there(asked)) {
        well = raw_given(asked, field, raw);
    } else {
        PyObject *held = attribute(&value, variable);
        well = held != NULL && raw_of(held, field, raw);
        forget(&held);
    }
    forget(&asked);
    return well;
}

bool sample_image(CodecObject *self, uint64_t *image)
{
    uint64_t raw;
    *image = 0;
    for (int place = 0; place < self->count; place++) {
        ImageField field = self->fields[place];
        if (field.kind == GAP)
            continue;
        PyObject *variable = another(self->variables[place]);
        bool well = raw_now(self->provided, variable, &field, &raw);
        Py_DecRef(variable);
        if (!well)
            return false;
        put_field(image, &field, raw);
    }
    return true;
}

PyObject *pack_octets(CodecObject *self)
{
    uint64_t image;
    unsigned char octets[8];
    if (!sample_image(self, &image))
        return NULL;
    int count = image_octets(self->bits);
    write_image(image, octets, count);
    return PyBytes_FromStringAndSize((const char *)octets, count);
}

static PyObject *call_pack(PyObject *self, PyObject *none)
{
    (void)none;
    return pack_octets(codec_of(self));
}

/* Whether the image differs from that of the last call: 1, 0, or -1 for an error. */
int look_at_image(CodecObject *self)
{
    uint64_t image;
    if (!sample_image(self, &image))
        return -1;
    bool changed = image != self->seen;
    self->seen = image;
    return changed;
}

static PyObject *call_changed(PyObject *self, PyObject *none)
{
    (void)none;
    int changed = look_at_image(codec_of(self));
    return changed < 0 ? NULL : PyBool_FromLong(changed);
}

static PyObject *value_from(uint64_t raw, const ImageField *field)
{
    switch (field->kind) {
    case REAL:
        return PyFloat_FromDouble(real_value(raw, field->bits));
    case SIGNED:
        return PyLong_FromLongLong(signed_value(raw, field->bits));
    case UNSIGNED:
    case GAP:
        break;
    }
    return PyLong_FromUnsignedLongLong(raw);
}

/* The values of the variables, with references, from at least image_octets(bits) octets; how many, or -1. */
int unpack_values(const CodecObject *self, const unsigned char *octets, PyObject **values)
{
    uint64_t image = read_image(octets, image_octets(self->bits));
    int filled = 0;
    for (int place = 0; place < self->count; place++) {
        const ImageField *field = &self->fields[place];
        if (field->kind == GAP)
            continue;
        assert(filled < self->variable_count);
        values[filled] = value_from(raw_field(image, field), field);
        if (values[filled] == NULL) {
            while (filled > 0)
                Py_DecRef(values[--filled]);
            return -1;
        }
        filled++;
    }
    return filled;
}

static PyObject *call_unpack(PyObject *self, PyObject *data)
{
    const CodecObject *codec = codec_of(self);
    PyObject *values[PDO_FIELDS_MAX];
    char *octets;
    Py_ssize_t length;
    if (PyBytes_AsStringAndSize(data, &octets, &length) < 0)
        return NULL;
    if (length < image_octets(codec->bits))
        return PyErr_Format(PyExc_ValueError, "%zd octets: at least %d expected", length, image_octets(codec->bits));
    int count = unpack_values(codec, (const unsigned char *)octets, values);
    PyObject *tuple = count < 0 ? NULL : PyTuple_New(count);
    for (int place = 0; place < count; place++) {
        if (tuple == NULL)
            Py_DecRef(values[place]);
        else
            PyTuple_SetItem(tuple, place, values[place]);
    }
    return tuple;
}

static PyMethodDef methods[] = {
    {"pack", call_pack, METH_NOARGS, NULL},
    {"unpack", call_unpack, METH_O, NULL},
    {"changed", call_changed, METH_NOARGS, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_codec},
    {Py_tp_clear, (void *)clear_codec},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {0},
};

PyType_Spec codec_spec = {
    .name = "servobench.virtual_bus.core.native.PdoCodec",
    .basicsize = sizeof(CodecObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
