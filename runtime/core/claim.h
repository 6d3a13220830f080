/* Claims: names that one process of the computer has at a time, such as a device's.
 *
 * A claim is an abstract Unix socket with that name. The kernel releases it when the process ends, in whatever way, and
 * tells who holds it; it needs no directory and no privilege, and is local to the network namespace. So any process may
 * hold any name. A service does not wait for a holder that it has no reason to respect, such as an app: it takes
 * another socket for the same name, and whoever looks for a holder looks at all of these.
 */
#ifndef FLOTILLA_CLAIM_H
#define FLOTILLA_CLAIM_H

#include <stdbool.h>
#include <sys/types.h>

enum claim_result {
    CLAIM_OURS,
    CLAIM_HELD,      /* by a process that counts */
    CLAIM_DEAF,      /* by one that does not listen: it has just begun to hold it, or is none of ours */
    CLAIM_BUSY,      /* by one for which too many wait, so that nobody knows who it is: it may be one that counts */
    CLAIM_STRANGERS, /* all its sockets are held by processes that do not count */
    CLAIM_ERROR,     /* errno says which */
};

struct claim {
    int fd;        /* CLAIM_OURS: it holds the claim. CLAIM_HELD: it ends with the holder. Otherwise -1 */
    pid_t process; /* CLAIM_HELD: who holds it; 0: unknown here */
};

/* Whether a user's process may exclude this one: root, users who log in, and this process's own user. For those who log
 * in, every process may. */
bool claim_user_counts(uid_t user);

/* Claim KIND/KEY. A long key is known by its end. `deaf`: to pass over such holders. Each call leaves a connection with
 * the holder, which has room for some: whoever has to know for long keeps `fd`. */
enum claim_result claim_take(const char *kind, const char *key, bool deaf, struct claim *claim);

#endif
