/* The frames of a synchronous TPDO beside the SYNCs that they answer. */
#ifndef CORE_ANSWERS_H
#define CORE_ANSWERS_H

#include "regular_stream.h"

enum {
    /* SYNCs that are remembered (servobench.hil.loop.syncs), and how many in a row may be missing. */
    SYNCS_MAX = 128,
    /* They, and before each of them the missing ones. */
    STARTS_MAX = SYNCS_MAX * SYNCS_MAX,
};

/* A SYNC: its end on the bus, or its hand-over. */
typedef struct Start {
    int64_t at, place;
} Start;

typedef struct Answer {
    int64_t at;
    Octets octets;
} Answer;

int fill_missing(const Start *told, int count, Start *starts);
bool pass_answers(Stream *self, int64_t *seen, const Start *starts, int count, const Answer *answers, int64_t came);

#endif
