// What wifi.cc asks of a network and learns of it: frames, who received them and when, and the report.

#pragma once

#include "ns3/core-module.h"
#include "ns3/network-module.h"
#include "ns3/wifi-module.h"

#include <algorithm>
#include <cinttypes>
#include <cstdio>
#include <fstream>
#include <sstream>
#include <string>
#include <vector>

using namespace ns3;

namespace
{
struct Options
{
    std::string standard{"b"}, rate{"1"}, positions, arrivals, errorModel{"table"}, fading{"none"}, out, control;
    double hz{10}, duration{10}, warmup{0}, drain{0.6}, exponent{3}, referenceLoss{40.052}, referenceDistance{1};
    double txPower{16.0206}, m{1}, preambleRssi{-82}, preambleSnr{4};
    uint32_t size{100}, seed{1}, queued{3};
    bool unicast{false}, sink{false}, ideal{false}, saturated{false}, detection{true}, delay{true}, log{false}, why{false};
};

struct Sent
{
    int64_t sender, seq, to, sentNs, firstNs{-1}, lastNs{-1}, attempts{0};
};

Options opt;
NetDeviceContainer devices;
std::vector<Sent> frames;
std::vector<int64_t> received; // frames x nodes
std::vector<uint8_t> why;      // frames x nodes, 1 + the last WifiPhyRxfailureReason
std::vector<int32_t> frameOf;  // by packet uid
std::vector<int64_t> next;     // sequence number of each sender
int64_t transmissions = 0, others = 0, dropped[4] = {}, rxDropped[32] = {};

int64_t Now()
{
    return Simulator::Now().GetNanoSeconds();
}

int32_t FrameOf(Ptr<const Packet> packet)
{
    const auto uid = static_cast<uint32_t>(packet->GetUid());
    return uid < frameOf.size() ? frameOf[uid] : -1;
}

void Log(uint32_t node, const std::string& what)
{
    std::fprintf(stderr, "%" PRId64 " %u %s\n", Now(), node, what.c_str());
}

void Send(uint32_t node, int to, uint32_t size)
{
    auto packet = Create<Packet>(size);
    const auto uid = static_cast<uint32_t>(packet->GetUid());
    if (uid >= frameOf.size())
    {
        frameOf.resize(2 * uid + 1000, -1);
    }
    frameOf[uid] = static_cast<int32_t>(frames.size());
    frames.push_back({node, next[node]++, to, Now()});
    received.resize(received.size() + next.size(), -1);
    why.resize(opt.why ? received.size() : 0);
    devices.Get(node)->Send(packet, to < 0 ? devices.Get(0)->GetBroadcast() : devices.Get(to)->GetAddress(), 0x0800);
}

int To(uint32_t node)
{
    if (opt.sink)
    {
        return 0;
    }
    return opt.unicast ? static_cast<int>((node + 1) % next.size()) : -1;
}

void SendPeriodically(uint32_t node, Time period)
{
    Send(node, To(node), opt.size);
    Simulator::Schedule(period, &SendPeriodically, node, period);
}

void SendAnother(uint32_t node)
{
    if (opt.saturated && !(opt.sink && node == 0)) // node 0 sends nothing but management
    {
        Simulator::ScheduleNow([node] { Send(node, To(node), opt.size); });
    }
}

void OnTx(uint32_t node, Ptr<const Packet> packet, double)
{
    const auto index = FrameOf(packet);
    if (opt.log)
    {
        Log(node, "tx " + (index < 0 ? std::string("control") : std::to_string(frames[index].seq)));
    }
    if (index < 0)
    {
        others++;
        return;
    }
    transmissions++;
    auto& frame = frames[index];
    frame.firstNs = frame.attempts == 0 ? Now() : frame.firstNs;
    frame.lastNs = Now();
    frame.attempts++;
    if (frame.to < 0)
    {
        SendAnother(node);
    }
}

bool OnReceived(uint32_t node, Ptr<const Packet> packet)
{
    const auto index = FrameOf(packet);
    if (index >= 0)
    {
        received[index * next.size() + node] = Now();
    }
    if (opt.log && index >= 0)
    {
        Log(node, "received " + std::to_string(frames[index].sender) + " " + std::to_string(frames[index].seq));
    }
    return true;
}

void OnRxDrop(uint32_t node, Ptr<const Packet> packet, WifiPhyRxfailureReason reason)
{
    const auto index = FrameOf(packet);
    rxDropped[std::min<int>(reason, 31)]++;
    if (opt.why && index >= 0)
    {
        why[index * next.size() + node] = 1 + reason;
    }
    if (opt.log)
    {
        std::ostringstream text;
        text << "rxdrop " << reason << " of " << (index < 0 ? -1 : frames[index].sender);
        Log(node, text.str());
    }
}

void Trace(uint32_t node)
{
    auto device = DynamicCast<WifiNetDevice>(devices.Get(node));
    auto phy = device->GetPhy();
    auto mac = device->GetMac();
    phy->TraceConnectWithoutContext("PhyTxBegin", Callback<void, Ptr<const Packet>, double>([node](auto p, auto w) { OnTx(node, p, w); }));
    phy->TraceConnectWithoutContext(
        "PhyRxDrop",
        Callback<void, Ptr<const Packet>, WifiPhyRxfailureReason>([node](auto p, auto reason) { OnRxDrop(node, p, reason); }));
    device->SetReceiveCallback(Callback<bool, Ptr<NetDevice>, Ptr<const Packet>, uint16_t, const Address&>(
        [node](Ptr<NetDevice>, Ptr<const Packet> p, uint16_t, const Address&) { return OnReceived(node, p); }));
    mac->TraceConnectWithoutContext("AckedMpdu", Callback<void, Ptr<const WifiMpdu>>([node](auto) { SendAnother(node); }));
    mac->TraceConnectWithoutContext("DroppedMpdu", Callback<void, WifiMacDropReason, Ptr<const WifiMpdu>>([node](auto reason, auto) {
                                        dropped[reason]++;
                                        SendAnother(node);
                                    }));
    if (opt.log)
    {
        const Ptr<Txop> txop = mac->GetQosSupported() ? Ptr<Txop>(mac->GetQosTxop(AC_BE)) : mac->GetTxop();
        txop->TraceConnectWithoutContext(
            "BackoffTrace", Callback<void, uint32_t, uint8_t>([node](auto slots, auto) { Log(node, "backoff " + std::to_string(slots)); }));
        txop->TraceConnectWithoutContext(
            "CwTrace", Callback<void, uint32_t, uint8_t>([node](auto cw, auto) { Log(node, "cw " + std::to_string(cw)); }));
        phy->GetState()->TraceConnectWithoutContext(
            "RxOk", Callback<void, Ptr<const Packet>, double, WifiMode, WifiPreamble>([node](auto packet, auto, auto, auto) {
                const auto index = FrameOf(packet);
                Log(node, index < 0 ? std::string("decoded control") : "decoded " + std::to_string(frames[index].sender));
            }));
        phy->GetState()->TraceConnectWithoutContext("State", Callback<void, Time, Time, WifiPhyState>([node](auto start, auto duration, auto state) {
            std::ostringstream text;
            text << "state " << state << " " << start.GetNanoSeconds() << " + " << duration.GetNanoSeconds();
            Log(node, text.str());
        }));
    }
}

void Report(uint32_t n, double cpuS)
{
    const int64_t from = std::llround(opt.warmup * 1e9), to = from + std::llround(opt.duration * 1e9);
    std::FILE* out = opt.out.empty() ? nullptr : std::fopen(opt.out.c_str(), "wb");
    std::vector<double> delays;
    int64_t counted = 0, wanted = 0, gone = 0;
    double bits = 0;
    for (size_t f = 0; f < frames.size(); f++)
    {
        const auto& frame = frames[f];
        if (frame.sentNs < from || frame.sentNs >= to)
        {
            continue;
        }
        counted++;
        gone += frame.attempts > 0;
        wanted += frame.to < 0 ? n - 1 : 1;
        for (uint32_t j = 0; j < n; j++)
        {
            if (received[f * n + j] >= 0)
            {
                delays.push_back((received[f * n + j] - frame.sentNs) / 1e6);
            }
        }
        if (out)
        {
            const int64_t row[7] = {frame.sender, frame.seq, frame.to, frame.sentNs, frame.firstNs, frame.lastNs, frame.attempts};
            std::fwrite(row, sizeof(int64_t), 7, out);
            std::fwrite(&received[f * n], sizeof(int64_t), n, out);
        }
    }
    for (size_t f = 0; f < received.size(); f++)
    {
        bits += received[f] >= from && received[f] < to ? 8.0 * opt.size : 0.0; // arrived in the measured time
    }
    if (out)
    {
        std::fclose(out);
        if (opt.why)
        {
            std::ofstream(opt.out + ".why", std::ios::binary).write(reinterpret_cast<const char*>(why.data()), why.size());
        }
    }
    std::sort(delays.begin(), delays.end());
    double sum = 0;
    for (double d : delays)
    {
        sum += d;
    }
    auto quantile = [&](double p) { return delays.empty() ? 0.0 : delays[std::min(delays.size() - 1, size_t(p * delays.size()))]; };
    std::printf("{\"nodes\": %u, \"frames\": %" PRId64 ", \"frames_on_air\": %" PRId64 ", \"receptions\": %zu, \"delivery_ratio\": %.6f, ",
                n, counted, gone, delays.size(), wanted ? double(delays.size()) / wanted : 0.0);
    std::printf("\"delay_ms\": {\"mean\": %.6f, \"p50\": %.6f, \"p95\": %.6f, \"p99\": %.6f}, ",
                delays.empty() ? 0.0 : sum / delays.size(), quantile(.5), quantile(.95), quantile(.99));
    std::printf("\"throughput_bps\": %.1f, \"transmissions\": %" PRId64 ", \"control_frames\": %" PRId64 ", ",
                bits / opt.duration, transmissions, others);
    std::printf("\"mac_drops\": {\"expired\": %" PRId64 ", \"retries\": %" PRId64 "}, \"phy_drops\": {", dropped[1], dropped[2]);
    const char* comma = "";
    for (int reason = 0; reason < 31; reason++)
    {
        if (rxDropped[reason])
        {
            std::ostringstream name;
            name << static_cast<WifiPhyRxfailureReason>(reason);
            std::printf("%s\"%s\": %" PRId64, comma, name.str().c_str(), rxDropped[reason]);
            comma = ", ";
        }
    }
    std::printf("}, \"events\": %" PRIu64 ", \"simulated_s\": %.3f, \"cpu_s\": %.4f}\n",
                Simulator::GetEventCount(), opt.warmup + opt.duration + opt.drain, cpuS);
}
} // namespace
