"""The fill: estimates of missing samples from splines, rigid clusters, the body and the whole marker set."""
