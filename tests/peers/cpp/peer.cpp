#include "peer.h"

#include <malloc.h>

extern "C" {

void peer_insert(Peer *peer, const double *row) { peer->insert(row); }

PeerResult peer_nearest(Peer *peer, const double *query, std::size_t k, bool more) {
    return peer->nearest(query, k, more);
}

PeerResult peer_within(Peer *peer, const double *query, double radius, bool more) {
    return peer->within(query, radius, more);
}

void peer_free(Peer *peer) { delete peer; }

std::size_t heap_bytes() {
    const struct mallinfo2 info = mallinfo2();
    // The sum of the arenas and of separate mappings.
    return info.uordblks + info.hblkhd;
}
}
