/* A controller with two rates, written as Embedded Coder writes reusable functions: put your model's code in its place.
 *
 *   command = Kp * error - Weights * rates + integral      each 10 ms
 *   integral += Ki * error * 50 ms, within +-Limit         each 50 ms
 *
 * Rate transitions ensure data integrity and determinism: the integral is that of the last 50 ms.
 */
#ifndef TWO_RATES_H
#define TWO_RATES_H
#include "rtwtypes.h"
#include "two_rates_types.h"
#include <stddef.h>

#ifndef rtmGetErrorStatus
#define rtmGetErrorStatus(rtm) ((rtm)->errorStatus)
#endif
#ifndef rtmSetErrorStatus
#define rtmSetErrorStatus(rtm, val) ((rtm)->errorStatus = (val))
#endif

/* Block states (default storage) for system '<Root>' */
typedef struct {
    real_T RateTransition_Buffer;   /* '<Root>/Rate Transition' */
    real_T RateTransition1_Buffer0; /* '<Root>/Rate Transition1' */
    real_T RateTransition1;         /* '<Root>/Rate Transition1' */
    real_T Integrator_DSTATE;       /* '<Root>/Integrator' */
} DW_two_rates_T;

/* External inputs (root inport signals with default storage) */
typedef struct {
    real_T error;     /* '<Root>/error' */
    real_T rates[2];  /* '<Root>/rates' */
    boolean_T enable; /* '<Root>/enable' */
} ExtU_two_rates_T;

/* External outputs (root outports fed by signals with default storage) */
typedef struct {
    real_T command;   /* '<Root>/command' */
    uint32_T updates; /* '<Root>/updates' */
} ExtY_two_rates_T;

/* Parameters (default storage) */
struct P_two_rates_T_ {
    real_T Kp;         /* Variable: Kp */
    real_T Ki;         /* Variable: Ki */
    real_T Limit;      /* Variable: Limit */
    real_T Weights[2]; /* Variable: Weights */
    boolean_T Integral; /* Variable: Integral */
};

/* Real-time Model Data Structure */
struct tag_RTM_two_rates_T {
    const char_T *volatile errorStatus;
    P_two_rates_T *defaultParam;
    DW_two_rates_T *dwork;
    struct {
        struct {
            uint8_T TID[2];
        } TaskCounters;
    } Timing;
};

/* Block parameters (default storage) */
extern P_two_rates_T two_rates_P;

/* Model entry point functions */
extern void two_rates_initialize(RT_MODEL_two_rates_T *const two_rates_M, ExtU_two_rates_T *two_rates_U,
    ExtY_two_rates_T *two_rates_Y);
extern void two_rates_step0(RT_MODEL_two_rates_T *const two_rates_M, ExtU_two_rates_T *two_rates_U,
    ExtY_two_rates_T *two_rates_Y);
extern void two_rates_step1(RT_MODEL_two_rates_T *const two_rates_M, ExtY_two_rates_T *two_rates_Y);
extern void two_rates_terminate(RT_MODEL_two_rates_T *const two_rates_M);

#endif
