/* Switches beside the axis whose contacts bounce, and the filter of the drive's inputs. */
#ifndef CORE_SWITCHES_H
#define CORE_SWITCHES_H

#include <stdbool.h>
#include <stdint.h>

enum { SWITCHES = 3, BOUNCES_MAX = 8 };

typedef struct Switches {
    int active; /* 0: nobody watches them */
    double low_turns[SWITCHES], high_turns[SWITCHES]; /* made from the first on, and before the second */
    double bounce_s; /* from the crossing of an edge until the contact rests; 0: it does not bounce */
    int bounces;     /* in that time it changes twice as often, once in each part of it */
    double filter_s; /* a change that lasts shorter is not seen */
    int64_t seed;
} Switches;

typedef struct SwitchState {
    int watched; /* the turns of the last tick are known */
    double turns, turns_s; /* of the load, and its speed, turns/s */
    bool made[SWITCHES];   /* whether the load is there */
    double crossed_s[SWITCHES], crossings[SWITCHES]; /* when an edge was crossed, s since power-on; how often */
} SwitchState;

/* At each tick: the period that ends at `now_s` has brought the load to there. */
void watch_switches(SwitchState *state, const Switches *switches, double turns, double turns_s, double now_s,
                    double period_s);
/* What the drive sees of one. */
bool switch_seen(const SwitchState *state, const Switches *switches, int which, double now_s);

#endif
