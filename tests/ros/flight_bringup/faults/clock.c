// SPDX-FileCopyrightText: RISE-DI contributors
// SPDX-License-Identifier: Apache-2.0
//
// A system clock that can be stepped for single processes. The library is loaded by LD_PRELOAD. FAULTS_CLOCK names a file of
// 8 bytes, the step in ns. A wait until an instant of the system clock ends when the stepped clock reaches that instant.

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

#define SECOND 1000000000LL
#define SLICE 50000000LL  // within this time a wait detects a step of the clock

static volatile int64_t *step;
static int (*real_gettime)(clockid_t, struct timespec *);
static int (*real_timedwait)(pthread_cond_t *, pthread_mutex_t *, const struct timespec *);

__attribute__((constructor)) static void begin(void) {
  real_gettime = dlsym(RTLD_NEXT, "clock_gettime");
  real_timedwait = dlvsym(RTLD_NEXT, "pthread_cond_timedwait", "GLIBC_2.3.2");
  const char *name = getenv("FAULTS_CLOCK");
  int file = name ? open(name, O_RDONLY) : -1;
  void *memory = file < 0 ? MAP_FAILED : mmap(NULL, 8, PROT_READ, MAP_SHARED, file, 0);
  if (file >= 0) close(file);
  if (memory != MAP_FAILED) step = memory;
}

static int64_t ns(const struct timespec *t) { return t->tv_sec * SECOND + t->tv_nsec; }

static struct timespec timespec_of(int64_t t) { return (struct timespec){t / SECOND, t % SECOND}; }

int clock_gettime(clockid_t clock, struct timespec *t) {
  if (!real_gettime) real_gettime = dlsym(RTLD_NEXT, "clock_gettime");
  int status = real_gettime(clock, t);
  if (status == 0 && step && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) *t = timespec_of(ns(t) + *step);
  return status;
}

int gettimeofday(struct timeval *restrict t, void *restrict zone) {
  struct timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  *t = (struct timeval){now.tv_sec, now.tv_nsec / 1000};
  return 0;
}

time_t time(time_t *t) {
  struct timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  if (t) *t = now.tv_sec;
  return now.tv_sec;
}

int pthread_cond_timedwait(pthread_cond_t *restrict condition, pthread_mutex_t *restrict mutex, const struct timespec *restrict until) {
  if (!step) return real_timedwait(condition, mutex, until);
  struct timespec real;
  real_gettime(CLOCK_REALTIME, &real);
  int64_t left = ns(until) - (ns(&real) + *step);
  struct timespec slice = timespec_of(ns(&real) + (left < SLICE ? left : SLICE));
  int status = real_timedwait(condition, mutex, &slice);
  // A spurious wakeup is allowed, a late one is not.
  return status == ETIMEDOUT && left > SLICE ? 0 : status;
}
