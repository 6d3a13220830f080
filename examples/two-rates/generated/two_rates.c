/* A sample of what Embedded Coder makes; two_rates.h says of what. */
#include "two_rates.h"
#include <string.h>

static void rate_monotonic_scheduler(RT_MODEL_two_rates_T *const two_rates_M)
{
    /* Compute which subrates run during the next base time step. */
    (two_rates_M->Timing.TaskCounters.TID[1])++;
    if ((two_rates_M->Timing.TaskCounters.TID[1]) > 4) {/* Sample time: [0.05s, 0.0s] */
        two_rates_M->Timing.TaskCounters.TID[1] = 0;
    }
}

/* Model step function for TID0 */
void two_rates_step0(RT_MODEL_two_rates_T *const two_rates_M, ExtU_two_rates_T *two_rates_U,
    ExtY_two_rates_T *two_rates_Y) /* Sample time: [0.01s, 0.0s] */
{
    P_two_rates_T *two_rates_P = two_rates_M->defaultParam;
    DW_two_rates_T *two_rates_DW = two_rates_M->dwork;

    /* RateTransition: '<Root>/Rate Transition' */
    if (two_rates_M->Timing.TaskCounters.TID[1] == 0) {
        two_rates_DW->RateTransition_Buffer = two_rates_U->error;

        /* RateTransition: '<Root>/Rate Transition1' */
        two_rates_DW->RateTransition1 = two_rates_DW->RateTransition1_Buffer0;
    }

    /* Outport: '<Root>/command' */
    if (two_rates_U->enable) {
        two_rates_Y->command = two_rates_P->Kp * two_rates_U->error - (two_rates_P->Weights[0] *
            two_rates_U->rates[0] + two_rates_P->Weights[1] * two_rates_U->rates[1]) +
            two_rates_DW->RateTransition1;
    } else {
        two_rates_Y->command = 0.0;
    }

    rate_monotonic_scheduler(two_rates_M);
}

/* Model step function for TID1 */
void two_rates_step1(RT_MODEL_two_rates_T *const two_rates_M, ExtY_two_rates_T *two_rates_Y)
    /* Sample time: [0.05s, 0.0s] */
{
    P_two_rates_T *two_rates_P = two_rates_M->defaultParam;
    DW_two_rates_T *two_rates_DW = two_rates_M->dwork;

    /* DiscreteIntegrator: '<Root>/Integrator' */
    if (two_rates_P->Integral) {
        two_rates_DW->Integrator_DSTATE += 0.05 * (two_rates_P->Ki * two_rates_DW->RateTransition_Buffer);
        if (two_rates_DW->Integrator_DSTATE > two_rates_P->Limit) {
            two_rates_DW->Integrator_DSTATE = two_rates_P->Limit;
        } else if (two_rates_DW->Integrator_DSTATE < -two_rates_P->Limit) {
            two_rates_DW->Integrator_DSTATE = -two_rates_P->Limit;
        }
    }

    /* RateTransition: '<Root>/Rate Transition1' */
    two_rates_DW->RateTransition1_Buffer0 = two_rates_DW->Integrator_DSTATE;

    /* Outport: '<Root>/updates' */
    two_rates_Y->updates++;
}

/* Model initialize function */
void two_rates_initialize(RT_MODEL_two_rates_T *const two_rates_M, ExtU_two_rates_T *two_rates_U,
    ExtY_two_rates_T *two_rates_Y)
{
    DW_two_rates_T *two_rates_DW = two_rates_M->dwork;

    /* initialize error status */
    rtmSetErrorStatus(two_rates_M, (NULL));

    /* states (dwork) */
    (void)memset((void *)two_rates_DW, 0, sizeof(DW_two_rates_T));

    /* external inputs */
    (void)memset(two_rates_U, 0, sizeof(ExtU_two_rates_T));

    /* external outputs */
    (void)memset(two_rates_Y, 0, sizeof(ExtY_two_rates_T));
}

/* Model terminate function */
void two_rates_terminate(RT_MODEL_two_rates_T *const two_rates_M)
{
    /* (no terminate code required) */
    (void)two_rates_M;
}
