/* The least that tracing rays with Embree can cost: a loop over rays in C, on all threads, that keeps nothing but the number of hits.
 * `lipac bench` compiles it (cc -O3 -shared -fPIC -pthread) and compares it with the project's own loop on the same rays and the same scene.
 * Embree's functions come as pointers, so neither its headers nor its library are needed to build this. */
#include <pthread.h>
#include <stddef.h>
#include <string.h>

/* RTCRayHit of Embree 4 with one level of instancing and instance arrays; both parts are 16-byte aligned. */
typedef struct {
    float org[3], tnear, dir[3], time, tfar;
    unsigned mask, id, flags;
    float ng[3], u, v;
    unsigned prim, geom, inst, inst_prim;
    unsigned padding[3];
} __attribute__((aligned(16))) RayHit;

typedef void (*Intersect1)(void *scene, RayHit *ray, void *arguments);

typedef struct {
    Intersect1 intersect;
    void *scene;
    const float *rays; /* org, dir: six floats a ray */
    size_t first, last;
    size_t hits;
} Part;

static void *run(void *argument) {
    Part *part = argument;
    size_t hits = 0;
    for (size_t i = part->first; i < part->last; i++) {
        RayHit ray;
        memcpy(ray.org, part->rays + 6 * i, sizeof ray.org);
        memcpy(ray.dir, part->rays + 6 * i + 3, sizeof ray.dir);
        ray.tnear = 0.0f;
        ray.time = 0.0f;
        ray.tfar = 1e30f;
        ray.mask = 0xFFFFFFFFu;
        ray.id = ray.flags = 0;
        ray.geom = ray.inst = ray.inst_prim = 0xFFFFFFFFu;
        part->intersect(part->scene, &ray, NULL);
        hits += ray.geom != 0xFFFFFFFFu;
    }
    part->hits = hits;
    return NULL;
}

/* Trace n rays on `threads` threads (at most 256); the number of hits. */
size_t bare_loop(Intersect1 intersect, void *scene, const float *rays, size_t n, int threads) {
    pthread_t handles[256];
    Part parts[256];
    size_t hits = 0;
    for (int t = 0; t < threads; t++) {
        Part part = {intersect, scene, rays, n * t / threads, n * (t + 1) / threads, 0};
        parts[t] = part;
        pthread_create(&handles[t], NULL, run, &parts[t]);
    }
    for (int t = 0; t < threads; t++) {
        pthread_join(handles[t], NULL);
        hits += parts[t].hits;
    }
    return hits;
}
