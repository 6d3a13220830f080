#define _GNU_SOURCE
#include "instance.h"

#include "core/claim.h"

#include <errno.h>
#include <fcntl.h>
#include <stdbool.h>
#include <stdio.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

/* Who holds a lock for writing on this file; 0 for nobody, 1 where the kernel does not say. */
static int holder(const struct stat *file)
{
    char line[256];
    FILE *locks = fopen("/proc/locks", "re");
    int found = locks ? 0 : 1;
    while (locks && fgets(line, sizeof line, locks)) {
        int process;
        unsigned long inode;
        /* 12: FLOCK  ADVISORY  WRITE 2312 fe:01:1234 0 EOF */
        if (sscanf(line, "%*u: FLOCK ADVISORY WRITE %d %*x:%*x:%lu", &process, &inode) == 2 && inode == file->st_ino)
            found = process;
    }
    if (locks)
        fclose(locks);
    return found;
}

/* Whether the lock of a process counts, by its user. */
static bool counts(int process)
{
    char line[256];
    unsigned user;
    bool counted = false;
    snprintf(line, sizeof line, "/proc/%d/status", process);
    FILE *status = fopen(line, "re");
    while (status && fgets(line, sizeof line, status)) {
        if (sscanf(line, "Uid: %u", &user) == 1)
            counted = claim_user_counts(user);
    }
    if (status)
        fclose(status);
    return counted;
}

int instance_lock(const char *path)
{
    struct stat file;
    int fd = open(path, O_RDONLY | O_CLOEXEC);
    if (fd < 0 || fstat(fd, &file) < 0)
        return -1;
    for (int i = 0; i < 2; i++) { /* who had it may have ended before it was looked at */
        if (flock(fd, LOCK_EX | LOCK_NB) == 0)
            return 0; /* held by the open descriptor */
        int process = errno == EWOULDBLOCK ? holder(&file) : -1;
        if (process < 0 || counts(process)) {
            close(fd);
            return process;
        }
    }
    close(fd);
    return 0;
}
