/* Whole numbers of floats. */
#include <math.h>

#include "arguments.h"
#include "types.h"

/* Python's round of a float: to the nearest, of two the even one (rint, IEEE 754, 5.3.1). */
PyObject *call_nearest(PyObject *module, PyObject *value)
{
    static const double exact = 4611686018427387904.0; /* 2^62: whatever is less is a long long */
    double given;
    (void)module;
    if (!number(value, &given))
        return NULL;
    double whole_number = rint(given);
    if (-exact < whole_number && whole_number < exact)
        return PyLong_FromLongLong((long long)whole_number);
    return PyLong_FromDouble(whole_number);
}
