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

static bool fill(PyObject *module)
{
    PyObject *type = PyType_FromSpec(&ring_spec);
    bool well = type != NULL && PyModule_AddObjectRef(module, "Ring", type) == 0
                && PyModule_AddStringConstant(module, "SOURCES_DIGEST", SOURCES_DIGEST) == 0;
    forget(&type);
    return well;
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
