/* UDP sockets of a block, bound to a local address and interface. These may be missing at first, go, and come back:
 * tasks start before the network is up. */
#ifndef FLOTILLA_CORE_UDP_SOCKETS_H
#define FLOTILLA_CORE_UDP_SOCKETS_H

#include <flotilla/driver.h>
#include <flotilla/failover.h>
#include <netinet/in.h>

struct udp_sockets {
    /* Set before udp_sockets_open: prepares a new socket before it is bound; true, or false with errno. Called by start
     * and by the thread that waits for the interface. */
    bool (*prepare)(int fd, const void *context);
    const void *context;

    /* For the step: the descriptors stay the same all the time. While the interface or the address is missing, nothing
     * arrives, and sending fails. */
    int fd[FL_SENDERS];
    size_t count;

    struct fl_block *block;
    struct sockaddr_in local;
    const char *interface;
    unsigned index; /* of the interface that the sockets are bound to; 0: it is not there */
    int error;      /* the last error that was logged */
    int changes_fd; /* readable after a change of interfaces */
    struct fl_driver *driver;
};

/* `count` sockets with a port of this computer (0: any free one each), at an address (INADDR_ANY: any) and an interface
 * ("": any). FL_FAILED after fl_fail(): a port that is taken, a name that is too long. */
int udp_sockets_open(struct udp_sockets *sockets, struct fl_block *block, size_t count, struct in_addr local_address,
                     int64_t port, const char *interface);

/* Also after udp_sockets_open() failed, and for an all-zero structure. */
void udp_sockets_close(struct udp_sockets *sockets);

#endif
