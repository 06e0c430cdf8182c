/* The module servobench.design.core.native; native.pyi says what it holds. */
#include <string.h>

#include "arguments.h"
#include "random_runs.h"

static PyObject *call_random_runs(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    (void)module;
    RandomRuns runs;
    const double *figures;
    Py_ssize_t length;
    int64_t first, number_of_runs;
    if (!takes(count, 8, "random_runs"))
        return NULL;
    uint64_t seed = PyLong_AsUnsignedLongLong(arguments[0]);
    if (PyErr_Occurred() || !integer(arguments[1], &first) || !integer(arguments[2], &number_of_runs)
        || !doubles(arguments[3], &figures, &length) || !integer(arguments[4], &runs.strategy)
        || !integer(arguments[5], &runs.losses_max) || !integer(arguments[6], &runs.behind)
        || !integer(arguments[7], &runs.steps))
        return NULL;
    if (length != sizeof runs.figures / sizeof(double) || number_of_runs < 0 || number_of_runs > INT32_MAX
        || runs.behind < 0 || runs.behind > INT32_MAX || runs.strategy < ON_ARRIVAL || runs.strategy > BY_HISTORY) {
        PyErr_Format(PyExc_ValueError, "%zd figures, %lld runs, %lld periods behind, strategy %lld", length,
                     (long long)number_of_runs, (long long)runs.behind, (long long)runs.strategy);
        return NULL;
    }
    memcpy(&runs.figures, figures, sizeof runs.figures);
    PyObject *peaks = PyBytes_FromStringAndSize(NULL, number_of_runs * (Py_ssize_t)sizeof(double));
    char *octets;
    if (peaks == NULL || PyBytes_AsStringAndSize(peaks, &octets, &length) < 0)
        return NULL;
    void *thread = PyEval_SaveThread();
    bool done = run_randomly(&runs, seed, (uint64_t)first, number_of_runs, (double *)octets);
    PyEval_RestoreThread(thread);
    if (!done) {
        Py_DecRef(peaks);
        return PyErr_NoMemory();
    }
    return peaks;
}

static PyMethodDef functions[] = {
    {"random_runs", (PyCFunction)(void (*)(void))call_random_runs, METH_FASTCALL, NULL},
    {0},
};

static PyModuleDef definition = {
    PyModuleDef_HEAD_INIT,
    .name = "native",
    .size = -1,
    .methods = functions,
};

PyMODINIT_FUNC PyInit_native(void)
{
    PyObject *module = PyModule_Create2(&definition, PYTHON_ABI_VERSION);
    if (module != NULL && (PyModule_AddStringConstant(module, "SOURCES_DIGEST", SOURCES_DIGEST) < 0)) {
        Py_DecRef(module);
        return NULL;
    }
    return module;
}
