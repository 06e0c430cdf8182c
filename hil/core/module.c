/* The module servobench.hil.core.native; native.pyi says what it holds. */
#include "objects.h"
#include "types.h"

static PyMethodDef functions[] = {
    {"frame_row", (PyCFunction)(void (*)(void))call_frame_row, METH_FASTCALL, NULL},
    {0},
};

static PyModuleDef definition = {
    PyModuleDef_HEAD_INIT,
    .name = "native",
    .size = -1,
    .methods = functions,
};

static bool add_type(PyObject *module, const char *name, PyType_Spec *spec)
{
    PyObject *type = PyType_FromSpec(spec);
    bool well = type != NULL && PyModule_AddObjectRef(module, name, type) == 0;
    forget(&type);
    return well;
}

static bool fill(PyObject *module)
{
    return add_type(module, "Ring", &ring_spec) && add_type(module, "RegularStream", &regular_stream_spec)
           && PyModule_AddStringConstant(module, "SOURCES_DIGEST", SOURCES_DIGEST) == 0;
}

PyMODINIT_FUNC PyInit_native(void)
{
    PyObject *module = PyModule_Create2(&definition, PYTHON_ABI_VERSION);
    if (module != NULL && !fill(module)) {
        Py_DecRef(module);
        return NULL;
    }
    return module;
}
