/* The module virtual_bus.core.native; native.pyi says what it holds. */
#include "arguments.h"
#include "rotation.h"
#include "types.h"
#include "wire_bits.h"

static PyObject *call_sine_cosine(PyObject *module, PyObject *angle)
{
    (void)module;
    double angle_rad;
    if (!number(angle, &angle_rad))
        return NULL;
    SineCosine turn = sine_cosine(angle_rad);
    PyObject *pair = PyTuple_New(2);
    if (pair == NULL)
        return NULL;
    PyTuple_SetItem(pair, 0, PyFloat_FromDouble(turn.sine));
    PyTuple_SetItem(pair, 1, PyFloat_FromDouble(turn.cosine));
    return pair;
}

static PyObject *call_wire_bits(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    (void)module;
    int64_t field;
    char *octets;
    Py_ssize_t length;
    if (!takes(count, 2, "wire_bits") || !integer(arguments[0], &field)
        || PyBytes_AsStringAndSize(arguments[1], &octets, &length) < 0)
        return NULL;
    if (field < 0 || length > 8) {
        PyErr_Format(PyExc_ValueError, "%zd octets, field %lld: at most 8, and at least 0 expected", length,
                     (long long)field);
        return NULL;
    }
    return PyLong_FromLongLong(wire_bits((uint64_t)field, (const unsigned char *)octets, (int)length));
}

static PyMethodDef functions[] = {
    {"sine_cosine", call_sine_cosine, METH_O, NULL},
    {"wire_bits", (PyCFunction)(void (*)(void))call_wire_bits, METH_FASTCALL, NULL},
    {0},
};

static PyModuleDef definition = {
    PyModuleDef_HEAD_INIT,
    .name = "native",
    .size = -1,
    .methods = functions,
};

static int add_type(PyObject *module, PyType_Spec *spec, const char *name)
{
    PyObject *type = PyType_FromSpec(spec);
    if (type == NULL)
        return -1;
    int result = PyModule_AddObjectRef(module, name, type);
    Py_DecRef(type);
    return result;
}

PyMODINIT_FUNC PyInit_native(void)
{
    make_wire_tables();
    PyObject *module = PyModule_Create2(&definition, PYTHON_ABI_VERSION);
    if (module != NULL && (PyModule_AddStringConstant(module, "SOURCES_DIGEST", SOURCES_DIGEST) < 0
                           || add_type(module, &inner_loops_spec, "InnerLoops") < 0)) {
        Py_DecRef(module);
        return NULL;
    }
    return module;
}
