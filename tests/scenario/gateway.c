/* CANopenNode's gateway (CiA 309-3) with its SDO client, on a bus that is the caller: frames go out by
   gateway_take and come in by gateway_frame. Its own headers and sources are not part of this project. */
#include "301/CO_SDOclient.h"
#include "301/CO_driver.h"
#include "309/CO_gateway_ascii.h"
#include "OD.h"

enum { FRAMES = 64, NODE = 127, TIMEOUT_MS = 500 };

static CO_CANmodule_t can;
static CO_CANrx_t received[1];
static CO_CANtx_t sent[1];
static CO_SDOclient_t client;
static CO_GTWA_t gateway;
static CO_frame_t frames[FRAMES];
static int frame_count;
static char answer[4096];
static size_t answer_length;

CO_ReturnError_t CO_CANrxBufferInit(CO_CANmodule_t *module, uint16_t index, uint16_t ident, uint16_t mask, bool_t rtr,
                                    void *object, void (*callback)(void *, void *))
{
    (void)rtr;
    module->rxArray[index] = (CO_CANrx_t){ident, mask, object, callback};
    return CO_ERROR_NO;
}

CO_CANtx_t *CO_CANtxBufferInit(CO_CANmodule_t *module, uint16_t index, uint16_t ident, bool_t rtr, uint8_t length,
                               bool_t sync)
{
    (void)rtr, (void)sync;
    module->txArray[index].ident = ident;
    module->txArray[index].DLC = length;
    return &module->txArray[index];
}

CO_ReturnError_t CO_CANsend(CO_CANmodule_t *module, CO_CANtx_t *buffer)
{
    (void)module;
    if (frame_count == FRAMES)
        return CO_ERROR_TX_OVERFLOW;
    CO_frame_t frame = {buffer->ident, buffer->DLC, {0}};
    memcpy(frame.data, buffer->data, sizeof frame.data);
    frames[frame_count++] = frame;
    return CO_ERROR_NO;
}

static size_t take_answer(void *object, const char *text, size_t length, uint8_t *connected)
{
    (void)object;
    *connected = 1;
    memcpy(answer + answer_length, text, length);
    answer_length += length;
    return length;
}

int gateway_begin(void)
{
    uint32_t where = 0;
    can = (CO_CANmodule_t){.rxArray = received, .rxSize = 1, .txArray = sent, .txSize = 1, .CANnormal = true};
    if (CO_SDOclient_init(&client, OD, OD_ENTRY_H1280_SDOClientParameter, NODE, &can, 0, &can, 0, &where))
        return 1;
    if (CO_GTWA_init(&gateway, &client, TIMEOUT_MS, false, 0))
        return 2;
    CO_GTWA_initRead(&gateway, take_answer, NULL);
    return 0;
}

void gateway_command(const char *text)
{
    answer_length = 0;
    CO_GTWA_write(&gateway, text, strlen(text));
}

void gateway_frame(uint32_t ident, int length, const uint8_t *data)
{
    CO_frame_t frame = {ident, (uint8_t)length, {0}};
    memcpy(frame.data, data, (size_t)length);
    if (((ident ^ received[0].ident) & received[0].mask & 0x7FF) == 0 && received[0].CANrx_callback)
        received[0].CANrx_callback(received[0].object, &frame);
}

void gateway_process(uint32_t passed_us)
{
    uint32_t next_us = UINT32_MAX;
    CO_GTWA_process(&gateway, true, passed_us, &next_us);
}

int gateway_take(CO_frame_t *to)
{
    int count = frame_count;
    memcpy(to, frames, (size_t)count * sizeof *to);
    frame_count = 0;
    return count;
}

const char *gateway_answer(void)
{
    answer[answer_length] = 0;
    return answer;
}
