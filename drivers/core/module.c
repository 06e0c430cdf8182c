/* The module servobench.drivers.core.native; native.pyi says what it holds. */
#include "inlet.h"
#include "objects.h"
#include "set_point_frame.h"
#include "types.h"

static PyMethodDef functions[] = {
    {"enter", (PyCFunction)(void (*)(void))call_enter, METH_FASTCALL, NULL},
    {"nearest", call_nearest, METH_O, NULL},
    {"data_frame", (PyCFunction)(void (*)(void))call_data_frame, METH_FASTCALL, NULL},
    {0},
};

static PyModuleDef definition = {
    PyModuleDef_HEAD_INIT,
    .name = "native",
    .size = -1,
    .methods = functions,
};

/* The fields of a frame, as servobench.drivers.record has them of a record. */
static bool name_fields(void)
{
    static const char *names[] = {"can_id", "data", "extended", "remote", "remote_length"};
    int count = sizeof names / sizeof *names;
    PyObject *fields = PyTuple_New(count);
    for (int place = 0; fields != NULL && place < count; place++) {
        PyObject *name = PyUnicode_FromString(names[place]);
        if (name == NULL)
            forget(&fields);
        else
            PyTuple_SetItem(fields, place, name);
    }
    bool well = fields != NULL && PyObject_SetAttrString((PyObject *)frame_type, "__match_args__", fields) == 0;
    forget(&fields);
    return well;
}

static bool fill(PyObject *module)
{
    PyTypeObject *pump_type, *stopwatch_type;
    return add_type(module, "WireFrame", &frame_spec, &frame_type) && name_fields()
           && add_type(module, "Link", &link_spec, &link_type) && add_type(module, "Pump", &pump_spec, &pump_type)
           && add_type(module, "Stopwatch", &stopwatch_spec, &stopwatch_type)
           && add_type(module, "CommandWatch", &command_watch_spec, &command_watch_type)
           && add_type(module, "FollowReports", &follow_reports_spec, &follow_reports_type)
           && add_type(module, "LastStatusword", &last_statusword_spec, &last_statusword_type)
           && add_type(module, "Reception", &reception_spec, &reception_type)
           && add_type(module, "Inlet", &inlet_spec, &inlet_type)
           && add_type(module, "SetPointFrame", &set_point_frame_spec, &set_point_frame_type)
           && PyModule_AddIntConstant(module, "TOLD_THE_SAME", TOLD_THE_SAME) == 0
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
