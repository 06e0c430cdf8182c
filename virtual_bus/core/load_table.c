#include "load_table.h"

#include <assert.h>
#include <math.h>

/* Puts into loads_nm the torques at `count` instants from at_s on; 0 N m before 0 s. `place`: a point not later
   than the first instant, or the first of all. Returns that of the last. */
int fill_loads(const LoadTable *table, double *loads_nm, double at_s, double period_s, int count, int place)
{
    const double *times_s = table->times_s, *torques_nm = table->torques_nm;
    const int last = table->points - 1;
    double from_s = 0.0, until_s = -INFINITY, level = 0.0, span_s = 1.0, rise = 0.0; /* of a piece between points */
    int skipped = 0; /* points between the last two pieces: so many may lie before the next */
    for (int number = 0; number < count; number++) {
        double now_s = at_s + number * period_s;
        if (now_s >= until_s) {
            int before = place;
            if (place + skipped < last && times_s[place + skipped] <= now_s)
                place += skipped;
            while (place < last && times_s[place + 1] <= now_s)
                place++;
            skipped = place - before > 1 ? place - before - 1 : 0;
            from_s = times_s[place], until_s = INFINITY, level = torques_nm[place], span_s = 1.0, rise = 0.0;
            if (now_s < from_s) {
                until_s = from_s;
            } else if (place < last) {
                until_s = times_s[place + 1];
                if (!table->held)
                    span_s = until_s - from_s, rise = torques_nm[place + 1] - level;
            }
        }
        assert(place >= 0 && place <= last);
        loads_nm[number] = now_s >= 0.0 ? level + (now_s - from_s) / span_s * rise : 0.0;
    }
    return place;
}
