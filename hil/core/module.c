/* The module servobench.hil.core.native; native.pyi says what it holds. */
#include "frames.h"
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

PyTypeObject *frame_type;

static bool fill(PyObject *module)
{
    PyTypeObject *stream_type, *sink_type;
    frame_type = find_frame_type();
    return frame_type != NULL && add_type(module, "Ring", &ring_spec, &ring_type)
           && add_type(module, "FrameSink", &sink_spec, &sink_type)
           && add_type(module, "RegularStream", &regular_stream_spec, &stream_type)
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
