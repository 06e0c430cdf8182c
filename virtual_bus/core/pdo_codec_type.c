/* Python's PdoCodec (native.pyi). */
#include <assert.h>

#include "attributes.h"
#include "pdo_image.h"
#include "types.h"

typedef struct CodecObject {
    PyObject head;
    bool provided; /* a variable may have a provider, which is asked in place of its value */
    int count, variable_count, bits;
    ImageField fields[PDO_FIELDS_MAX];
    PyObject *variables[PDO_FIELDS_MAX]; /* NULL: a gap */
} CodecObject;

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

static PyObject *value_of(const CodecObject *self, PyObject *variable)
{
    static Attribute value = {.spelt = "value"}, provider = {.spelt = "provider"};
    if (!self->provided)
        return attribute(&value, variable);
    PyObject *asked = attribute(&provider, variable);
    if (asked == NULL || asked == Py_None) {
        forget(&asked);
        return PyErr_Occurred() ? NULL : attribute(&value, variable);
    }
    PyObject *given = PyObject_Vectorcall(asked, NULL, 0, NULL);
    Py_DecRef(asked);
    return given;
}

static bool raw_of(PyObject *value, const ImageField *field, uint64_t *raw)
{
    int64_t whole_number = 0;
    double real;
    int bits = 8 * image_octets(field->bits); /* a number is held in whole octets */
    bool fits = true;
    if (field->kind == REAL) {
        if (!number(value, &real))
            return false;
        *raw = raw_real(real, field->bits);
        double held = real_value(*raw, field->bits);
        fits = held - held == 0.0 || real - real != 0.0; /* finite, or never was */
    } else if (field->kind == UNSIGNED && bits == 64) {
        *raw = PyLong_AsUnsignedLongLong(value);
        return *raw != UINT64_MAX || !PyErr_Occurred();
    } else {
        if (!integer(value, &whole_number))
            return false;
        *raw = (uint64_t)whole_number;
        fits = field->kind == SIGNED ? fits_signed(whole_number, bits)
                                     : whole_number >= 0 && fits_unsigned(*raw, bits);
    }
    if (!fits)
        PyErr_Format(PyExc_ValueError, "a value that %d bits do not hold: %lld", field->bits, (long long)whole_number);
    return fits;
}

static PyObject *call_pack(PyObject *self, PyObject *none)
{
    (void)none;
    CodecObject *codec = codec_of(self);
    uint64_t image = 0, raw;
    for (int place = 0; place < codec->count; place++) {
        ImageField field = codec->fields[place];
        if (field.kind == GAP)
            continue;
        PyObject *variable = another(codec->variables[place]);
        PyObject *value = value_of(codec, variable);
        Py_DecRef(variable);
        bool well = value != NULL && raw_of(value, &field, &raw);
        forget(&value);
        if (!well)
            return NULL;
        put_field(&image, &field, raw);
    }
    unsigned char octets[8];
    write_image(image, octets, image_octets(codec->bits));
    return PyBytes_FromStringAndSize((const char *)octets, image_octets(codec->bits));
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

static PyObject *call_unpack(PyObject *self, PyObject *data)
{
    const CodecObject *codec = codec_of(self);
    char *octets;
    Py_ssize_t length;
    if (PyBytes_AsStringAndSize(data, &octets, &length) < 0)
        return NULL;
    int used = image_octets(codec->bits);
    if (length < used)
        return PyErr_Format(PyExc_ValueError, "%zd octets: at least %d expected", length, used);
    uint64_t image = read_image((const unsigned char *)octets, used);
    PyObject *values = PyTuple_New(codec->variable_count);
    int filled = 0;
    for (int place = 0; values != NULL && place < codec->count; place++) {
        const ImageField *field = &codec->fields[place];
        if (field->kind == GAP)
            continue;
        assert(filled < codec->variable_count);
        PyObject *value = value_from(raw_field(image, field), field);
        if (value == NULL)
            forget(&values);
        else
            PyTuple_SetItem(values, filled++, value);
    }
    return values;
}

static PyMethodDef methods[] = {
    {"pack", call_pack, METH_NOARGS, NULL},
    {"unpack", call_unpack, METH_O, NULL},
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
