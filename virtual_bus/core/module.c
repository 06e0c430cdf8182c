/* The module servobench.virtual_bus.core.native; native.pyi says what it holds. */
#include "actual_values.h"
#include "arguments.h"
#include "device.h"
#include "faults.h"
#include "frames.h"
#include "host_place.h"
#include "hub_record.h"
#include "pdo_image.h"
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

static PyObject *call_clipped(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    (void)module;
    double value;
    int64_t bits;
    if (!takes(count, 2, "clipped") || !number(arguments[0], &value) || !integer(arguments[1], &bits))
        return NULL;
    if (bits < 1 || bits > 32)
        return PyErr_Format(PyExc_ValueError, "%lld bits: 1 to 32 expected", (long long)bits);
    return whole(clipped(value, (int)bits));
}

static PyObject *call_user_position(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    (void)module;
    double values[2];
    if (!takes(count, 2, "user_position") || !numbers(arguments, values, 2))
        return NULL;
    return whole(user_position(values[0], values[1]));
}

static PyMethodDef functions[] = {
    {"enter", (PyCFunction)(void (*)(void))call_enter, METH_FASTCALL, NULL},
    {"clipped", (PyCFunction)(void (*)(void))call_clipped, METH_FASTCALL, NULL},
    {"user_position", (PyCFunction)(void (*)(void))call_user_position, METH_FASTCALL, NULL},
    {"sine_cosine", call_sine_cosine, METH_O, NULL},
    {"pack_frame", (PyCFunction)(void (*)(void))call_pack_frame, METH_FASTCALL, NULL},
    {"unpack_frame", call_unpack_frame, METH_O, NULL},
    {"wire_bits", (PyCFunction)(void (*)(void))call_wire_bits, METH_FASTCALL, NULL},
    {0},
};

static PyModuleDef definition = {
    PyModuleDef_HEAD_INIT,
    .name = "native",
    .size = -1,
    .methods = functions,
};

typedef struct ShownNumber {
    const char *name;
    long value;
} ShownNumber;

static const ShownNumber shown_numbers[] = {
    {"LONGEST_FRAME_BITS", LONGEST_FRAME_BITS},
    {"INTERMISSION_BITS", INTERMISSION_BITS},
    {"TRANSMIT_QUEUE_MAX", TRANSMIT_QUEUE_MAX},
    {"RECEIVE_QUEUE_MAX", RECEIVE_QUEUE_MAX},
    {"HUB_FRAME_BYTES", HUB_FRAME_BYTES},
    {"HUB_PACKET_BYTES_MAX", HUB_PACKET_BYTES_MAX},
    {"HELD_MAX", HELD_MAX},
    {"CHECKPOINTS_MAX", CHECKPOINTS_MAX},
    {"BLOCK_ENTRIES", BLOCK_ENTRIES},
    {"INDEPENDENT", INDEPENDENT},
    {"NUMBERED", NUMBERED},
    {"BURST", BURST},
    {"PERIODIC", PERIODIC},
    {"FIRST", FIRST},
    {"GAP", GAP},
    {"UNSIGNED", UNSIGNED},
    {"SIGNED", SIGNED},
    {"REAL", REAL},
};

typedef struct ShownType {
    PyType_Spec *spec;
    const char *name;
    PyTypeObject **place; /* for those that the core itself asks for */
} ShownType;

static const ShownType shown_types[] = {
    {&inner_loops_spec, "InnerLoops", &inner_loops_type},
    {&timeline_spec, "Timeline", &timeline_type},
    {&event_spec, "Event", &event_type},
    {&clock_spec, "SimulatedClock", NULL},
    {&load_spec, "BusLoad", &load_type},
    {&segment_spec, "Segment", &segment_type},
    {&port_spec, "Port", &port_type},
    {&held_spec, "HeldFrames", &held_type},
    {&place_spec, "HostPlace", &place_type},
    {&hub_end_spec, "HubEnd", NULL},
    {&codec_spec, "PdoCodec", &codec_type},
    {&drive_spec, "CyclicDrive", &drive_type},
    {&device_spec, "CyclicDevice", &device_type},
    {&timer_spec, "Timer", &timer_type},
    {&tpdo_spec, "CyclicTpdo", &tpdo_type},
    {&rpdo_spec, "CyclicRpdo", &rpdo_type},
    {&device_clock_spec, "DeviceClock", &device_clock_type},
    {&sync_spec, "SyncTaker", &sync_type},
    {&seat_spec, "DeviceSeat", &seat_type},
    {&numbers_spec, "UniformNumbers", &numbers_type},
    {&strike_spec, "Strike", &strike_type},
    {&hold_spec, "Hold", &hold_type},
    {&queue_spec, "Queue", &queue_type},
    {&route_spec, "Route", &route_type},
    {&block_spec, "EntryBlock", &block_type},
    {&fates_spec, "Fates", &fates_type},
};

static bool show_type(PyObject *module, const ShownType *shown)
{
    PyObject *type = PyType_FromSpec(shown->spec);
    if (type == NULL)
        return false;
    bool well = PyModule_AddObjectRef(module, shown->name, type) == 0;
    if (well && shown->place != NULL)
        *shown->place = (PyTypeObject *)type; /* and a reference, as long as the process is there */
    else
        Py_DecRef(type);
    return well;
}

PyTypeObject *frame_type;

static bool fill(PyObject *module)
{
    frame_type = find_frame_type();
    if (frame_type == NULL)
        return false;
    if (PyModule_AddStringConstant(module, "SOURCES_DIGEST", SOURCES_DIGEST) < 0)
        return false;
    for (size_t place = 0; place < sizeof shown_numbers / sizeof *shown_numbers; place++) {
        if (PyModule_AddIntConstant(module, shown_numbers[place].name, shown_numbers[place].value) < 0)
            return false;
    }
    for (size_t place = 0; place < sizeof shown_types / sizeof *shown_types; place++) {
        if (!show_type(module, &shown_types[place]))
            return false;
    }
    return true;
}

PyMODINIT_FUNC PyInit_native(void)
{
    make_wire_tables();
    PyObject *module = PyModule_Create2(&definition, PYTHON_ABI_VERSION);
    if (module != NULL && !fill(module)) {
        Py_DecRef(module);
        return NULL;
    }
    return module;
}
