/* UDP sockets of a block, bound to an address and an interface of this computer that need not be there yet, and may go
 * and come back: tasks start before the network is up. */
#ifndef FLOTILLA_IO_UDP_SOCKETS_H
#define FLOTILLA_IO_UDP_SOCKETS_H

#include <flotilla/driver.h>
#include <flotilla/failover.h>
#include <netinet/in.h>

struct udp_sockets {
    /* Set before udp_sockets_open: what a new socket needs before it has a port, true or false with errno. It is called
     * by start and by the thread that waits for the interface. */
    bool (*prepare)(int fd, const void *context);
    const void *context;

    /* The step's to use, and the same descriptors all the time. Nothing comes, and what is sent fails, while the
     * interface or the address is not there. */
    int fd[FL_SENDERS];
    size_t count;

    struct fl_block *block;
    struct sockaddr_in local;
    const char *interface;
    unsigned index; /* of the interface that the sockets are bound to; 0: it is not there */
    int error;      /* last told */
    int changes_fd; /* readable after interfaces changed */
    struct fl_driver *driver;
};

/* `count` sockets with a port of this computer (0: any free one each), at an address (INADDR_ANY: any) and an interface
 * ("": any). FL_FAILED after fl_fail(): a port that is taken, a name that is too long. */
int udp_sockets_open(struct udp_sockets *sockets, struct fl_block *block, size_t count, struct in_addr local_address,
                     int64_t port, const char *interface);

/* Also after an open that failed, and for zeroes. */
void udp_sockets_close(struct udp_sockets *sockets);

#endif
