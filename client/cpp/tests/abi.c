// The C ABI: answers, errors, and pointers that are null.
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <wayfold.h>

#define CHECK(condition)                                                                                               \
    do {                                                                                                               \
        if (!(condition)) {                                                                                            \
            fprintf(stderr, "abi.c:%d: %s (%s)\n", __LINE__, #condition, wayfold_error_message());                     \
            exit(1);                                                                                                   \
        }                                                                                                              \
    } while (0)

static wayfold_index *kept = NULL;

// The variables of the thread are destroyed before this function runs, the library's last error and its buffer among them.
static void at_exit(void) {
    const double state[2] = {1, 2};
    const wayfold_search search = wayfold_search_default();
    uint64_t id = 9;
    size_t size = 0;
    if (wayfold_index_search(kept, state, 1, 2, &search, 1, &id, NULL, &size, NULL) != WAYFOLD_CODE_OK || size != 1 ||
        id != 0) {
        _Exit(2);
    }
    wayfold_index_free(kept);
    if (wayfold_index_size(NULL, &size) != WAYFOLD_CODE_INVALID_ARGUMENT || strcmp(wayfold_error_message(), "") != 0) {
        _Exit(1);
    }
}

int main(void) {
    CHECK(atexit(at_exit) == 0);
    CHECK(strlen(wayfold_version()) >= 5);
    const double origin[2] = {0, 0};
    CHECK(wayfold_index_in_memory("R2", true, &kept) == WAYFOLD_CODE_OK);
    CHECK(wayfold_index_insert(kept, origin, 1, 2, NULL) == WAYFOLD_CODE_OK);
    wayfold_index *index = NULL;
    CHECK(wayfold_index_in_memory("R2*SO2", true, &index) == WAYFOLD_CODE_OK);
    CHECK(wayfold_index_width(index) == 3);

    double states[100 * 3];
    for (int row = 0; row < 100; row++) {
        states[row * 3] = row;
        states[row * 3 + 1] = 0;
        states[row * 3 + 2] = 0.01 * row;
    }
    uint64_t ids[100];
    CHECK(wayfold_index_insert(index, states, 100, 3, ids) == WAYFOLD_CODE_OK);
    size_t size = 0;
    CHECK(wayfold_index_size(index, &size) == WAYFOLD_CODE_OK && size == 100);

    // Many states, one call.
    wayfold_search search = wayfold_search_default();
    search.k = 4;
    uint64_t near[100 * 4];
    double distances[100 * 4];
    size_t found[100];
    CHECK(wayfold_index_search(index, states, 100, 3, &search, 4, near, distances, found, NULL) == WAYFOLD_CODE_OK);
    for (int row = 0; row < 100; row++) {
        CHECK(found[row] == 4 && near[row * 4] == ids[row] && distances[row * 4] == 0);
    }
    // A row without room gets the nearest.
    search.k = 0;
    search.radius = 10;
    uint64_t revision = 0, later = 0;
    CHECK(wayfold_index_search(index, states, 1, 3, &search, 2, near, distances, found, &revision) == WAYFOLD_CODE_OK);
    CHECK(found[0] == 10 && near[1] == ids[1]);
    // A search of many states has its revision too.
    CHECK(wayfold_index_search(index, states, 2, 3, &search, 2, near, distances, found, &later) == WAYFOLD_CODE_OK);
    CHECK(revision > 0 && later == revision);
    // A capacity without a buffer may be any number, and one for which no buffer is large enough is named.
    const size_t huge_capacity = SIZE_MAX / 8 + 1;
    CHECK(wayfold_index_search(index, states, 2, 3, &search, huge_capacity, NULL, NULL, found, NULL) == WAYFOLD_CODE_OK);
    CHECK(found[0] == 10 && found[1] == 11);
    CHECK(wayfold_index_search(index, states, 2, 3, &search, huge_capacity, near, NULL, found, NULL) ==
          WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(strcmp(wayfold_error_field(), "capacity") == 0);
    // The results of many states need no capacity.
    wayfold_results *results = NULL;
    const uint64_t *near_ids = NULL;
    const double *near_distances = NULL;
    CHECK(wayfold_index_search_many(index, states, 2, 3, &search, &results, &later) == WAYFOLD_CODE_OK);
    CHECK(results != NULL && later == revision);
    CHECK(wayfold_results_get(results, 0, &near_ids, &near_distances) == 10);
    CHECK(near_ids[9] == ids[9] && near_distances[0] == 0 && near_distances[9] > 9);
    CHECK(wayfold_results_get(results, 1, &near_ids, NULL) == 11 && near_ids[0] == ids[1]);
    CHECK(wayfold_results_get(results, 2, NULL, NULL) == 0);
    wayfold_results_free(results);
    wayfold_results_free(NULL);
    CHECK(wayfold_index_search_many(index, NULL, 2, 3, &search, &results, NULL) == WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(results == NULL && strcmp(wayfold_error_field(), "states") == 0);
    CHECK(wayfold_index_search_many(index, states, 2, 3, &search, NULL, NULL) == WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(strcmp(wayfold_error_field(), "results") == 0);
    // A factor of 0 is a factor: the nearest one, and the radius 0. A negative one is none.
    search = wayfold_search_default();
    search.k_factor = 0;
    CHECK(wayfold_index_search(index, states, 1, 3, &search, 2, near, NULL, found, NULL) == WAYFOLD_CODE_OK);
    CHECK(found[0] == 1 && near[0] == ids[0]);
    search = wayfold_search_default();
    search.radius_factor = 0;
    CHECK(wayfold_index_search(index, states, 1, 3, &search, 2, near, NULL, found, NULL) == WAYFOLD_CODE_OK);
    CHECK(found[0] == 1 && near[0] == ids[0]);
    search.radius_factor = -7;
    CHECK(wayfold_index_search(index, states, 1, 3, &search, 2, near, NULL, found, NULL) == WAYFOLD_CODE_OK);
    CHECK(found[0] == 100);
    search.radius_factor = NAN;
    CHECK(wayfold_index_search(index, states, 1, 3, &search, 2, near, NULL, found, NULL) ==
          WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(strcmp(wayfold_error_field(), "radius_factor") == 0);
    CHECK(strstr(wayfold_error_message(), "radius_factor: ") == wayfold_error_message());
    search.radius_factor = 1;
    search.radius = -1;
    CHECK(wayfold_index_search(index, states, 1, 3, &search, 2, near, NULL, found, NULL) ==
          WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(strcmp(wayfold_error_field(), "radius") == 0);
    search = wayfold_search_default();
    search.radius = 10;
    CHECK(wayfold_index_search(index, states, 1, 3, &search, 2, near, distances, found, NULL) == WAYFOLD_CODE_OK);
    double between = 0;
    CHECK(wayfold_index_distance(index, states, states + 3, 3, &between) == WAYFOLD_CODE_OK);
    CHECK(between == distances[1]);

    uint64_t nearest = 0;
    bool is_there = false;
    CHECK(wayfold_index_remove(index, ids[0], &is_there) == WAYFOLD_CODE_OK && is_there);
    CHECK(wayfold_index_remove(index, ids[0], &is_there) == WAYFOLD_CODE_OK && !is_there);
    CHECK(wayfold_index_nearest(index, states, 3, &nearest, &between, &is_there) == WAYFOLD_CODE_OK);
    CHECK(is_there && nearest == ids[1]);
    CHECK(wayfold_index_replace(index, ids[1], states, 3, &is_there) == WAYFOLD_CODE_OK && is_there);

    wayfold_point point = wayfold_point_default();
    point.id = 1000;
    point.tag = 7;
    point.payload = (const uint8_t *)"edge";
    point.payload_bytes = 4;
    uint64_t id = 0;
    search = wayfold_search_default();
    search.k = 1;
    CHECK(wayfold_index_insert_with(index, states, 3, &point, &id, &search, 4, near, distances, found, &later) ==
          WAYFOLD_CODE_OK);
    CHECK(id == 1000 && found[0] == 1 && near[0] == ids[1] && later > revision);
    // The first search could not see the moved point and the new one.
    search.k = 0;
    search.since = revision;
    CHECK(wayfold_index_search(index, states, 1, 3, &search, 4, near, NULL, found, NULL) == WAYFOLD_CODE_OK);
    CHECK(found[0] == 2 && near[0] == ids[1] && near[1] == 1000);
    search.since = later;
    CHECK(wayfold_index_search(index, states, 1, 3, &search, 4, near, NULL, found, NULL) == WAYFOLD_CODE_OK);
    CHECK(found[0] == 0);
    CHECK(wayfold_index_insert_with(index, states, 3, &point, &id, NULL, 0, NULL, NULL, NULL, NULL) ==
          WAYFOLD_CODE_ALREADY_EXISTS);
    CHECK(strcmp(wayfold_error_reason(), "ID_TAKEN") == 0 && strcmp(wayfold_error_field(), "id") == 0);
    size_t bytes = 0;
    // Many payloads, one call: null without a point, and not null without bytes.
    const uint64_t requested[3] = {1000, 4000, ids[2]};
    wayfold_payloads *payloads = NULL;
    CHECK(wayfold_index_payloads(index, requested, 3, &payloads) == WAYFOLD_CODE_OK && payloads != NULL);
    CHECK(memcmp(wayfold_payloads_get(payloads, 0, &bytes), "edge", 4) == 0 && bytes == 4);
    CHECK(wayfold_payloads_get(payloads, 1, NULL) == NULL && wayfold_payloads_get(payloads, 3, NULL) == NULL);
    CHECK(wayfold_payloads_get(payloads, 2, &bytes) != NULL && bytes == 0);
    wayfold_payloads_free(payloads);
    CHECK(wayfold_index_payloads(index, NULL, 3, &payloads) == WAYFOLD_CODE_INVALID_ARGUMENT && payloads == NULL);
    char space[8] = {0};
    CHECK(wayfold_index_space(index, space, 4, &bytes) == WAYFOLD_CODE_OK && bytes == 6);
    CHECK(strcmp(space, "R2*S") == 0);
    double state[3];
    uint64_t tag = 0;
    CHECK(wayfold_index_get(index, 1000, &tag, state, 3, &is_there) == WAYFOLD_CODE_OK && is_there && tag == 7);

    wayfold_points *points = NULL;
    CHECK(wayfold_index_scan(index, &points) == WAYFOLD_CODE_OK && wayfold_points_count(points) == 100);
    CHECK(wayfold_points_ids(points)[99] == 1000 && wayfold_points_tags(points)[99] == 7);
    wayfold_points_free(points);
    CHECK(wayfold_index_changes(index, 0, &points) == WAYFOLD_CODE_OK && points != NULL);
    size_t removed = 0;
    CHECK(wayfold_points_removed(points, &removed)[0] == ids[0] && removed == 1);
    const uint64_t read_revision = wayfold_points_read_revision(points);
    wayfold_points_free(points);
    // The revision of now, without points.
    CHECK(wayfold_index_changes(index, UINT64_MAX, &points) == WAYFOLD_CODE_OK && points != NULL);
    CHECK(wayfold_points_read_revision(points) == read_revision && wayfold_points_count(points) == 0);
    wayfold_points_free(points);
    // In memory an insert sees all: no answers are to come.
    wayfold_answers *answers = NULL;
    wayfold_answer answer;
    CHECK(wayfold_index_meanwhile(index, 0, &answers) == WAYFOLD_CODE_OK && answers != NULL);
    CHECK(wayfold_answers_count(answers) == 0 && wayfold_answers_open(answers) == 0);
    CHECK(!wayfold_answers_have_dropped(answers) && !wayfold_answers_get(answers, 0, &answer));
    wayfold_answers_free(answers);
    // Nor has it a connection, or writes that a server has not taken.
    wayfold_status status = WAYFOLD_STATUS_FOLLOWING;
    CHECK(wayfold_index_status(index, &status, NULL, NULL, 0, &bytes) == WAYFOLD_CODE_OK);
    CHECK(status == WAYFOLD_STATUS_NOT_SHARED && bytes == 0);
    wayfold_unsent *unsent = NULL;
    wayfold_unsent_write write;
    CHECK(wayfold_index_take_unsent(index, &unsent) == WAYFOLD_CODE_OK && unsent != NULL);
    CHECK(wayfold_unsent_count(unsent) == 0 && !wayfold_unsent_get(unsent, 0, &write));
    wayfold_unsent_free(unsent);
    CHECK(wayfold_index_close(index, 0, NULL) == WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(wayfold_index_flush(index) == WAYFOLD_CODE_OK && wayfold_index_flush_within(index, 0) == WAYFOLD_CODE_OK);
    // An index in memory declares nothing about its payloads.
    uint32_t encoding = 9;
    CHECK(wayfold_index_payload_encoding(index, &encoding) == WAYFOLD_CODE_OK && encoding == 0);
    CHECK(wayfold_index_payload_encoding(index, NULL) == WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(strcmp(wayfold_error_field(), "payload_encoding") == 0);
    // A server of which only the defaults are known has no address.
    wayfold_server server = wayfold_server_default();
    wayfold_index *opened = NULL;
    CHECK(wayfold_index_remote(&server, &opened) == WAYFOLD_CODE_INVALID_ARGUMENT && opened == NULL);
    CHECK(strcmp(wayfold_error_field(), "uri") == 0 && strcmp(wayfold_error_reason(), "NULL_POINTER") == 0);
    // Bytes that are no choice.
    server.uri = "https://127.0.0.1:1";
    server.name = "cell";
    server.reads_latest = 2;
    CHECK(wayfold_index_remote(&server, &opened) == WAYFOLD_CODE_INVALID_ARGUMENT && opened == NULL);
    CHECK(strcmp(wayfold_error_field(), "reads_latest") == 0);
    // A certificate without its key.
    server.reads_latest = 1;
    server.client_certificate = "PEM";
    CHECK(wayfold_index_shared(&server, &opened) == WAYFOLD_CODE_INVALID_ARGUMENT && opened == NULL);
    CHECK(strcmp(wayfold_error_field(), "client_key") == 0);
    // No server.
    CHECK(wayfold_index_shared(NULL, &opened) == WAYFOLD_CODE_INVALID_ARGUMENT && opened == NULL);
    CHECK(strcmp(wayfold_error_field(), "server") == 0 && strcmp(wayfold_error_reason(), "NULL_POINTER") == 0);
    CHECK(wayfold_index_remote(NULL, &opened) == WAYFOLD_CODE_INVALID_ARGUMENT && opened == NULL);
    CHECK(strcmp(wayfold_error_field(), "server") == 0 && strcmp(wayfold_error_reason(), "NULL_POINTER") == 0);

    // Errors name the field and the reason.
    states[3 * 5 + 1] = NAN;
    CHECK(wayfold_index_insert(index, states, 100, 3, ids) == WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(strcmp(wayfold_error_field(), "states[5].coords[1]") == 0);
    CHECK(strcmp(wayfold_error_reason(), "INVALID_STATE") == 0 && wayfold_error_rows_done() == 0);
    CHECK(wayfold_index_insert(index, states, 1, 4, ids) == WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(strcmp(wayfold_error_reason(), "WRONG_WIDTH") == 0);
    CHECK(wayfold_index_insert(index, states, SIZE_MAX, 3, ids) == WAYFOLD_CODE_INVALID_ARGUMENT);
    // Lengths that no slice has: nothing is read.
    const size_t huge = SIZE_MAX / 2;
    CHECK(wayfold_index_nearest(index, states, huge, &nearest, &between, &is_there) == WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(strcmp(wayfold_error_reason(), "WRONG_WIDTH") == 0);
    CHECK(wayfold_index_distance(index, states, states, huge, &between) == WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(wayfold_index_replace(index, 1000, states, huge, &is_there) == WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(wayfold_index_search(index, states, 1, huge, &search, 4, near, NULL, found, NULL) ==
          WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(strcmp(wayfold_error_reason(), "WRONG_WIDTH") == 0);
    point = wayfold_point_default();
    CHECK(wayfold_index_insert_with(index, states, huge, &point, &id, NULL, 0, NULL, NULL, NULL, NULL) ==
          WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(strcmp(wayfold_error_reason(), "WRONG_WIDTH") == 0);
    const uint8_t payload[1] = {0};
    point.payload = payload;
    point.payload_bytes = SIZE_MAX;
    CHECK(wayfold_index_insert_with(index, states, 3, &point, &id, NULL, 0, NULL, NULL, NULL, NULL) ==
          WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(strcmp(wayfold_error_field(), "payload") == 0);
    CHECK(wayfold_index_set_payload(index, 1000, payload, SIZE_MAX, &is_there) == WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(wayfold_index_payloads(index, requested, huge, &payloads) == WAYFOLD_CODE_INVALID_ARGUMENT && payloads == NULL);
    CHECK(strcmp(wayfold_error_field(), "ids") == 0);
    CHECK(wayfold_index_insert(index, NULL, 1, 3, ids) == WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(strcmp(wayfold_error_reason(), "NULL_POINTER") == 0);
    CHECK(wayfold_index_size(NULL, &size) == WAYFOLD_CODE_INVALID_ARGUMENT);
    CHECK(strcmp(wayfold_error_field(), "index") == 0);
    wayfold_index *none = NULL;
    CHECK(wayfold_index_in_memory("R3*", true, &none) == WAYFOLD_CODE_INVALID_ARGUMENT && none == NULL);
    CHECK(strcmp(wayfold_error_reason(), "INVALID_SPACE") == 0);

    size = 0;
    CHECK(wayfold_index_size(index, &size) == WAYFOLD_CODE_OK && size == 100);
    CHECK(wayfold_index_remove_all(index) == WAYFOLD_CODE_OK);
    CHECK(wayfold_index_size(index, &size) == WAYFOLD_CODE_OK && size == 0);
    CHECK(wayfold_index_clear(index) == WAYFOLD_CODE_OK);
    CHECK(wayfold_index_nearest(index, states, 3, &nearest, &between, &is_there) == WAYFOLD_CODE_OK && !is_there);
    wayfold_index_free(index);
    wayfold_index_free(NULL);
    puts("abi: ok");
    return 0;
}
