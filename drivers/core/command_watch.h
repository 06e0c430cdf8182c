/* Whether a drive follows its commands, by what it reports: Python's CommandWatch. */
#ifndef CORE_COMMAND_WATCH_H
#define CORE_COMMAND_WATCH_H

#include <stdbool.h>

#include "stable_abi.h"

enum {
    /* Equal torque demands, each after a further command, that occur by chance once in some million: in thousandths
       of the rated torque, one in nine varying commands equals the one before. */
    TOLD_THE_SAME = 8
};

typedef struct CommandWatch {
    int64_t half, margin, share, least, stays_for;
    bool equal, has_least;
    int64_t *recent; /* a ring of `half` commands: `held` of them, the newest at `newest` */
    int64_t held, newest;
    int64_t *ways; /* room for as many */
    int64_t sent, followed, told_raw;
    int64_t changed; /* commands sent before the demand took its present value; -1: reported once, or measured */
    int64_t same;    /* repetitions of that value since, each after a further command */
    int64_t base, low, high; /* the command at that time, and how far the later ones lie below and above it */
    int64_t heard;           /* commands sent before the last report */
    bool follows;
} CommandWatch;

typedef struct CommandWatchObject {
    PyObject head;
    CommandWatch watch;
} CommandWatchObject;

bool is_told(PyObject *object, int64_t *raw);
void command_sent(CommandWatch *self, int64_t raw);
void command_excused(CommandWatch *self);
void command_told(CommandWatch *self, int64_t raw, bool limited);

#endif
