/* Bits of the statusword 6041h (CiA 402-2, 8.4.2). */
#ifndef CORE_STATUSWORD_H
#define CORE_STATUSWORD_H

enum {
    STATE_BITS = 0x6F,
    OPERATION_ENABLED = 0x27, /* among the state bits */
    INTERNAL_LIMIT_ACTIVE = 0x800,
};

#endif
