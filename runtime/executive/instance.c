#define _GNU_SOURCE
#include "instance.h"

#include <errno.h>
#include <fcntl.h>
#include <stdbool.h>
#include <stdio.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

/* Who holds a lock on this file; 1 where the kernel does not say. */
static int holder(const struct stat *file)
{
    char line[256];
    int found = 1;
    FILE *locks = fopen("/proc/locks", "re");
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

int instance_lock(const char *path)
{
    struct stat file;
    int fd = open(path, O_RDONLY | O_CLOEXEC);
    if (fd < 0 || fstat(fd, &file) < 0)
        return -1;
    if (flock(fd, LOCK_EX | LOCK_NB) == 0)
        return 0; /* held by the open descriptor */
    int process = errno == EWOULDBLOCK ? holder(&file) : -1;
    close(fd);
    return process;
}
