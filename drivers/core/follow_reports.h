/* Whether a drive follows its commands, by the mode and the statusword that it reports: Python's FollowReports. */
#ifndef CORE_FOLLOW_REPORTS_H
#define CORE_FOLLOW_REPORTS_H

#include "objects.h"

typedef struct FollowReportsObject {
    PyObject head;
    PyObject *changed; /* called with the instant of a report that differs from the one before */
    int64_t commanded, shown, bit;
    int64_t mode_at; /* when the mode shown came */
    int64_t older;   /* reports of another mode before the commanded one was shown */
    int64_t older_max;
    bool ignores, mode_shown, bit_watched;
    bool lapsed; /* the drive does not follow; kept by the class on top */
} FollowReportsObject;

bool follow_mode(FollowReportsObject *self, int64_t shown, int64_t at);
bool follow_status(FollowReportsObject *self, int64_t statusword, int64_t at);

#endif
