/*
 * Time from the write of a byte to its arrival at a waiting thread, through a UART whose output is its own input.
 *
 *     serial_latency DEVICE COUNT   prints a histogram in microseconds, in the shape of cyclictest --json
 *     serial_latency DEVICE load    keeps the port as busy as 115200 Bd would, until SIGTERM
 *
 * The UART's loopback (MCR bit 4) needs no cable; nothing reaches the connector. One byte is under way at a time, every
 * PERIOD_NS. Both threads are SCHED_FIFO, above the interrupt threads, with their memory locked.
 */
#define _GNU_SOURCE
#include <asm/termbits.h> /* conflicts with <termios.h>, whose features are not needed */
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <sched.h>
#include <semaphore.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

#ifndef TIOCM_LOOP
#define TIOCM_LOOP 0x8000
#endif

enum {
    PERIOD_NS = 10 * 1000 * 1000,
    LOAD_PERIOD_NS = 1000 * 1000,
    LOAD_BYTES = 12, /* each LOAD_PERIOD_NS: 115200 Bd carry 11.5 */
    TIMEOUT_S = 2,
    BUCKETS = 100 * 1000, /* µs; what is later is in `max` */
    READER_PRIORITY = 91,
    WRITER_PRIORITY = 90,
    LOAD_PRIORITY = 50,
};

static int port;
static _Atomic int64_t written_ns; /* handed over by the byte itself */
static sem_t arrived;
static unsigned histogram[BUCKETS];
static int64_t latest_us;

static void fail(const char *what)
{
    fprintf(stderr, "serial_latency: %s: %s\n", what, strerror(errno));
    exit(1);
}

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

static void sleep_until(int64_t deadline_ns)
{
    struct timespec deadline = {.tv_sec = deadline_ns / 1000000000, .tv_nsec = deadline_ns % 1000000000};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &deadline, NULL) == EINTR)
        ;
}

/* Raw, 115200 Bd, output led back to input. */
static void open_port(const char *path)
{
    struct termios2 settings;
    int lines = TIOCM_DTR | TIOCM_RTS | TIOCM_LOOP;

    port = open(path, O_RDWR | O_NOCTTY);
    if (port < 0)
        fail(path);
    memset(&settings, 0, sizeof settings);
    settings.c_cflag = CS8 | CREAD | CLOCAL | B115200;
    settings.c_cc[VMIN] = 1;
    if (ioctl(port, TCSETSF2, &settings))
        fail("settings");
    if (ioctl(port, TIOCMSET, &lines))
        fail("loopback");
}

/* A port that stays open elsewhere would stay in loopback. */
static void leave(int unused)
{
    int loop = TIOCM_LOOP;

    (void)unused;
    ioctl(port, TIOCMBIC, &loop);
    _exit(0);
}

static pthread_t start(void *(*body)(void *), int priority)
{
    struct sched_param parameter = {.sched_priority = priority};
    pthread_attr_t attributes;
    pthread_t thread;

    pthread_attr_init(&attributes);
    pthread_attr_setinheritsched(&attributes, PTHREAD_EXPLICIT_SCHED);
    pthread_attr_setschedpolicy(&attributes, SCHED_FIFO);
    pthread_attr_setschedparam(&attributes, &parameter);
    errno = pthread_create(&thread, &attributes, body, NULL);
    if (errno)
        fail("thread");
    return thread;
}

static void *receive(void *unused)
{
    for (unsigned char expected = 0;; expected++) {
        unsigned char byte;
        if (read(port, &byte, 1) != 1)
            fail("read");
        int64_t latency_us = (now_ns() - written_ns) / 1000;
        if (byte != expected) {
            fprintf(stderr, "serial_latency: byte %u arrived as %u\n", expected, byte);
            exit(1);
        }
        if (latency_us < BUCKETS)
            histogram[latency_us]++;
        if (latency_us > latest_us)
            latest_us = latency_us;
        sem_post(&arrived);
    }
    return unused;
}

static unsigned long count;

static void *send(void *unused)
{
    int64_t next_ns = now_ns();

    for (unsigned long sent = 0; sent < count; sent++) {
        unsigned char byte = (unsigned char)sent;
        struct timespec deadline;

        do
            next_ns += PERIOD_NS;
        while (next_ns <= now_ns()); /* after a late byte: no burst */
        sleep_until(next_ns);
        written_ns = now_ns();
        if (write(port, &byte, 1) != 1)
            fail("write");
        clock_gettime(CLOCK_REALTIME, &deadline);
        deadline.tv_sec += TIMEOUT_S;
        while (sem_timedwait(&arrived, &deadline))
            if (errno != EINTR)
                fail("a byte did not arrive");
    }
    return unused;
}

static void *discard(void *unused)
{
    char bytes[256];
    while (read(port, bytes, sizeof bytes) > 0)
        ;
    fail("read");
    return unused;
}

static void *stream(void *unused)
{
    static const char bytes[LOAD_BYTES];
    for (int64_t next_ns = now_ns();; next_ns += LOAD_PERIOD_NS) {
        sleep_until(next_ns);
        if (write(port, bytes, sizeof bytes) < 0)
            fail("write");
    }
    return unused;
}

static void print(void)
{
    const char *comma = "";

    printf("{\"thread\": {\"0\": {\"cycles\": %lu, \"max\": %lld, \"histogram\": {", count, (long long)latest_us);
    for (unsigned bucket = 0; bucket < BUCKETS; bucket++)
        if (histogram[bucket]) {
            printf("%s\"%u\": %u", comma, bucket, histogram[bucket]);
            comma = ", ";
        }
    printf("}}}}\n");
}

int main(int argc, char **argv)
{
    if (argc != 3) {
        fprintf(stderr, "usage: serial_latency DEVICE COUNT|load\n");
        return 2;
    }
    open_port(argv[1]);
    signal(SIGTERM, leave);
    signal(SIGINT, leave);
    if (mlockall(MCL_CURRENT | MCL_FUTURE))
        fail("mlockall");
    sem_init(&arrived, 0, 0);
    if (strcmp(argv[2], "load") == 0) {
        start(discard, LOAD_PRIORITY);
        pthread_join(start(stream, LOAD_PRIORITY), NULL);
    }
    count = strtoul(argv[2], NULL, 10);
    start(receive, READER_PRIORITY);
    pthread_join(start(send, WRITER_PRIORITY), NULL);
    print();
    fflush(stdout);
    leave(0);
}
