/* A load torque over time that the shaft bears by itself. */
#ifndef CORE_LOAD_TABLE_H
#define CORE_LOAD_TABLE_H

#include <stdbool.h>

/* Points in time; between them straight or held, before the first and after the last as there. */
typedef struct LoadTable {
    const double *times_s; /* rising */
    const double *torques_nm;
    int points;
    bool held;
} LoadTable;

int fill_loads(const LoadTable *table, double *loads_nm, double at_s, double period_s, int count, int place);

#endif
